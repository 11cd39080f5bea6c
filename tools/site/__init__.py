"""The documentation site: sources of its pages, pages generated from the code, and diagrams."""
