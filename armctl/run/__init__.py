"""What happens: what executes a motion, the simulated plant, and links to robots."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules={"links"})
