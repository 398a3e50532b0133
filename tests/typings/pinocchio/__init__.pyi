# Compiled modules without type information: everything in them is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
