"""The documentation site: where its pages come from, what the build makes of the code, diagrams."""
