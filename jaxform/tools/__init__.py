"""The mold: its shapes, its search structure, distances to it and what penetrates it."""
