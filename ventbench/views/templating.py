"""Pages from templates, with one set of rules: text is escaped, and a missing value is an error."""

from __future__ import annotations

import jinja2


def template(name: str, package: str = "ventbench.views") -> jinja2.Template:
    """Return a template that lies in ``templates/`` of a package."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
