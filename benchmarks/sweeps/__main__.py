"""Runs the parts that are named, or all: `python -m benchmarks.sweeps stress client cold designs memory`."""

from __future__ import annotations

import json
import sys
from typing import Any

from benchmarks.sweeps import designs, stress

PARTS: dict[str, Any] = {
    "stress": lambda: stress.show_stress(kill_client=False),
    "client": lambda: stress.show_stress(kill_client=True),
    "cold": stress.show_cold,
    "designs": designs.show_designs,
    "memory": designs.show_memory,
}

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        print(f"{part}: {json.dumps(PARTS[part](), indent=2)}", flush=True)
