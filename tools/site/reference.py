"""The pages that are generated from the code, in the order of the site."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sceneprint.settings import Settings
from service.app import create_app
from tools.site import http_pages
from tools.site.client_page import client_page
from tools.site.code_pages import commands_page


@dataclass(frozen=True)
class GeneratedPage:
    """A page of the site without a source file.

    Parameters
    ----------
    path : path on the site
    title : title in the navigation
    text : Markdown
    about : summary for the index; "" omits the page there
    group : group in the navigation; "" for none
    """

    path: str
    title: str
    text: str
    about: str = ""
    group: str = ""


def generated_pages() -> list[GeneratedPage]:
    """Return all generated pages."""
    return [
        *http_reference(),
        GeneratedPage(
            "reference/client.md", "Python client", client_page(), "every class and method"
        ),
        GeneratedPage(
            "reference/commands.md", "Command line", commands_page(), "every command and option"
        ),
    ]


def api_document() -> dict[str, Any]:
    """Return the OpenAPI document of a service."""
    with TemporaryDirectory() as folder:
        return create_app(Settings(data_dir=Path(folder))).openapi()


def http_reference() -> list[GeneratedPage]:
    """Return the pages of the HTTP API."""
    document = api_document()
    http_page = partial(GeneratedPage, group="HTTP API")
    return [
        http_page(
            "reference/http/index.md", "HTTP API", http_pages.index_page(document),
            "every operation: parameters, bodies, statuses",
        ),
        *(
            http_page(
                f"reference/http/{name}.md", name.capitalize(),
                http_pages.resource_page(name, document),
            )
            for name in http_pages.resources(document)
        ),
        http_page("reference/http/records.md", "Records", http_pages.records_page(document)),
    ]  # fmt: skip
