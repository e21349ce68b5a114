"""Starts a worker process: `python -m cow_service.workers FD`."""

import gc
import sys

if __name__ == "__main__":
    gc.disable()  # nothing that is imported is garbage: looking for it takes a fifth of the time
    from cow_service.workers.child import main

    gc.freeze()
    gc.enable()
    main(int(sys.argv[1]))
