"""Host work before a run: a scene built from its parts."""
