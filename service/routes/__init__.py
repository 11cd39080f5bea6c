"""The routes, with a file per kind of resource."""
