"""HTTP and people: the API, the Python client and the command line."""
