"""The command, a file for each part of it. It alone knows both jaxform and optimize."""

from jaxform.cli.command import main

__all__ = ["main"]
