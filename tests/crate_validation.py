# SPDX-License-Identifier: Apache-2.0
"""Validate an RO-Crate with roc-validator, without a network.

Run this in a Python that has `roc-validator` and `rocrate`. The validator fetches only
the JSON-LD context; `rocrate` contains a later one with all terms of version 1.1.
"""

import json
import sys
from importlib import resources


def main(folder):
    """Print the problems of the crate in a folder, and return their number."""
    context = json.loads(
        resources.files("rocrate").joinpath("data/ro-crate.jsonld").read_text()
    )

    class Fetched:
        status_code = 200
        text = json.dumps(context)
        content = text.encode()
        headers = {"Content-Type": "application/ld+json"}  # noqa: RUF012  as in requests

        def json(self):
            return context

        def raise_for_status(self): ...

    from rocrate_validator.utils.http import HttpRequester

    for method in ("get", "head"):
        setattr(HttpRequester, method, lambda *_, **__: Fetched())

    from rocrate_validator.models import Severity
    from rocrate_validator.services import ValidationSettings, validate

    result = validate(
        ValidationSettings(
            rocrate_uri=folder,
            profile_identifier="process-run-crate",
            requirement_severity=Severity.REQUIRED,
        )
    )
    issues = result.get_issues()
    for issue in issues:
        sys.stdout.write(f"{issue.check.identifier}: {issue.message}\n")
    return len(issues)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
