"""How studies show what they found: tables, figures and pages, for all of them.

Numbers are texts (:mod:`~adaptive_contact_studies.show.numbers`), pages are templates of jinja2 in
``templates`` (:mod:`~adaptive_contact_studies.show.pages`), figures are matplotlib's
(:mod:`~adaptive_contact_studies.show.figures`).
"""
