"""Whether there is a screen, on which a browser can open."""

import os
import sys
import webbrowser


def open_browser(address: str) -> bool:
    """Opens an address in a browser, where there is a screen. Returns whether a browser starts."""
    screen = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(screen) and webbrowser.open(address)
