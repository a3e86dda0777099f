"""How studies show what they found, for all of them.

Pages in Markdown are templates of jinja2 in ``templates``, with numbers as text
(:mod:`~adaptive_contact_studies.show.pages`); figures are matplotlib's
(:mod:`~adaptive_contact_studies.show.figures`).
"""
