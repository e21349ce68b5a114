"""Worker processes: each computes jobs apart from the process that takes them. A crash harms the job that caused it."""
