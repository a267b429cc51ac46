"""Time integration: the step, the window of steps, and the lengths of both."""
