"""The live page: a small HTTP server and the page that it serves.  Imports no zenoh.

:mod:`frames` turns what the service says into JSON, :mod:`server` gives it to browsers, and
:mod:`page` runs both on threads of their own.
"""

from __future__ import annotations

from adaptive_contact.web.page import LivePage
from adaptive_contact.web.server import WebSettings

__all__ = ["LivePage", "WebSettings"]
