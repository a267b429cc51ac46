"""Time: the step, the window of steps, and how long both are."""
