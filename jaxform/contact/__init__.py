"""Contact with tools: candidates, broad phase, landing, sliding, and sides held at sharp edges."""
