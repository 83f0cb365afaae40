"""Whether a server answers at all, found out quickly."""

import socket
import threading
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

PATIENCE_SECONDS = 0.8


class Probe:
    """An attempt to connect, made in the background.

    The hub's own client tries again for half a minute before it gives up.

    Args:
        url: Address of the server, http or https. Through a proxy where the environment names one.
    """

    def __init__(self, url: str) -> None:
        self._answered = False
        self._thread = threading.Thread(target=self._connect, args=(url,), daemon=True)
        self._thread.start()

    def answers(self) -> bool:
        """Whether the server, or the proxy, took the connection in time."""
        self._thread.join(PATIENCE_SECONDS)
        return self._answered

    def _connect(self, url: str) -> None:
        parts = urlsplit(url)
        proxy = getproxies().get(parts.scheme)
        if proxy and not proxy_bypass(parts.hostname or ""):
            parts = urlsplit(proxy if "//" in proxy else f"//{proxy}")
        port = parts.port or (443 if parts.scheme == "https" else 80)
        try:
            # The name is looked up first, for which no time limit can be set: hence the thread.
            with socket.create_connection((parts.hostname or "", port), PATIENCE_SECONDS):
                self._answered = True
        except OSError:
            pass
