"""Keeps an older import: ``LearnerBank`` is a name of ``adaptive_contact`` itself now."""

from adaptive_contact.core.bank import LearnerBank

__all__ = ["LearnerBank"]
