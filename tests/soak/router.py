"""A router alone, to be killed: ``python router.py ENDPOINT``."""

from __future__ import annotations

import sys
import threading

from adaptive_contact.service.link import Link, router_settings

__all__ = ["main"]


def main() -> None:
    """Listen until killed; the endpoint is told on stdout, so that port 0 is of use."""
    with Link.open(router_settings([sys.argv[1]])) as link:
        print(link.endpoints[0], flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
