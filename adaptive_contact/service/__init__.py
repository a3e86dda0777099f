"""Runs the learners behind Zenoh: link, intake, server, watch, doctor, record, replay."""
