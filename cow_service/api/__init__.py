"""The HTTP side: it turns requests into calls of the service and errors into problems. It computes nothing."""
