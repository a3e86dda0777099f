"""How studies show what they found: pages in Markdown from templates of jinja2."""
