"""The paper's experiments, and what they leave out: data, identification, detection, report.

:func:`~adaptive_contact_studies.paper.run.run_paper` runs them all, resumable.
"""
