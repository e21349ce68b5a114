"""Worker processes: each computes jobs apart from the process that takes them. A crash ends only its own job."""
