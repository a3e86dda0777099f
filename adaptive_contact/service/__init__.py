"""The Zenoh shell around the learners: link, intake, server, watch, doctor, record, replay."""
