"""The dashboard: an HTTP server on the loopback interface, a client of the daemon like any other."""
