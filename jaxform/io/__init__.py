"""Scene and study files, results and pictures on disk. It alone knows pydantic and matplotlib."""
