"""The pages that are made from the code, in the order in which the site lists them."""

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
from tools.site.code_pages import commands_page, metrics_page
from tools.site.error_page import error_page


@dataclass(frozen=True)
class GeneratedPage:
    """A page of the site that no file holds.

    Parameters
    ----------
    path : on the site
    title : in the navigation
    text : Markdown
    about : what it holds, for the index; "" to leave it out there
    group : of the navigation that it is listed below; "" for none
    """

    path: str
    title: str
    text: str
    about: str = ""
    group: str = ""


def generated_pages() -> list[GeneratedPage]:
    """All of them."""
    return [
        *http_reference(),
        GeneratedPage(
            "reference/errors.md", "Errors", error_page(), "every problem: status, cause, remedy"
        ),
        GeneratedPage(
            "reference/client.md", "Python client", client_page(), "every class and method"
        ),
        GeneratedPage(
            "reference/commands.md", "Command line", commands_page(), "every command and option"
        ),
        GeneratedPage("reference/metrics.md", "Metrics", metrics_page(), "what Prometheus is told"),
    ]


def api_document() -> dict[str, Any]:
    """The OpenAPI document of a service."""
    with TemporaryDirectory() as folder:
        return create_app(Settings(data_dir=Path(folder))).openapi()


def http_reference() -> list[GeneratedPage]:
    """Pages of the HTTP API."""
    document = api_document()
    made = partial(GeneratedPage, group="HTTP API")
    return [
        made(
            "reference/http/index.md", "HTTP API", http_pages.index_page(document),
            "every operation: parameters, bodies, statuses",
        ),
        *(
            made(
                f"reference/http/{name}.md", name.capitalize(),
                http_pages.resource_page(name, document),
            )
            for name in http_pages.resources(document)
        ),
        made("reference/http/records.md", "Records", http_pages.records_page(document)),
    ]  # fmt: skip
