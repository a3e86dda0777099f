"""Serves the live page: a small HTTP server and the page itself.  Imports no zenoh.

:mod:`.frames` turns the service's messages into JSON, :mod:`.server` gives it to browsers, and
:mod:`.page` runs both on threads of their own.
"""

from __future__ import annotations

from adaptive_contact.web.page import LivePage
from adaptive_contact.web.server import WebSettings

__all__ = ["LivePage", "WebSettings"]
