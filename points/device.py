"""What a device may be called; whether it is here is `model.filter.device_named`'s to say, and takes torch."""

from __future__ import annotations

import re

__all__ = ["DEVICE_NAME"]

DEVICE_NAME = re.compile(r"auto|cpu|cuda(:\d{1,3})?")
