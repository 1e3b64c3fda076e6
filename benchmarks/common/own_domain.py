"""Imported before ROS: nodes of a benchmark talk in a domain of their own on this machine; helpers of the tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
sys.path.append(str(Path(__file__).resolve().parents[2] / "test" / "helpers"))
