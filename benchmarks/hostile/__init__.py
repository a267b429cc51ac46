"""Damaged files, journals and caches, and runs that are killed."""
