"""Reverse derivatives: the reversed scheme, and the strategies a user can choose."""
