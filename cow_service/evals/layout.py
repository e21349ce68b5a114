"""What a folder of results holds: the names of its files and folders."""

RUN, ITEMS = "run.json", "items.jsonl"  # what was asked
PICTURES = "pictures"  # by digest: images and frames
LOGS = "logs"  # Inspect's
CACHE = "cache"  # every reply that has come
SERVER = "server"  # the data and the log of a server in the process
REPORT = "report"
