"""Drives Dynamixel and Feetech buses: packets, control tables, the SDKs, the control cycle.

Only this package imports the SDKs and serial, and of it only :mod:`.port` and :mod:`.bus`:
packets and tables are plain data, which the virtual bus of the simulator uses too.  Nothing here
knows Zenoh; who runs a bridge hands it an :class:`~adaptive_contact.bridge.transport.Outlet`.
"""
