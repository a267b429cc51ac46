"""What is simulated: the scene, its fields, and how its numbers are replaced."""
