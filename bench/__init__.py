"""Benchmarks of multidrop. They use the helpers of its tests."""

import sys
from pathlib import Path

sys.path.extend(map(str, (Path(__file__).parents[1] / "tests" / "support").iterdir()))
