"""The server: jobs, workers and the REST API."""
