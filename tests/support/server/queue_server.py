"""A server's queue in a process of its own, to be killed: ``python queue_server.py DATA_DIR``.

It begins with the states of all runs, and tells them again for every line that it reads.
"""

import json
import sys
from pathlib import Path

from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from app.settings import ServerSettings


def main() -> None:
    settings = ServerSettings(data_dir=Path(sys.argv[1]), parallel_fits=2)
    catalog = Catalog(settings)
    scheduler = Scheduler(settings, catalog, worker="support.server.job_worker")
    scheduler.start()

    def tell() -> None:
        runs = [item for item in catalog.runs() if not item.is_bundled]
        states = {item.id: scheduler.view(item).state for item in runs}
        sys.stdout.write(json.dumps(states) + "\n")
        sys.stdout.flush()

    tell()
    for _ in sys.stdin:
        tell()
    scheduler.shutdown()


if __name__ == "__main__":
    main()
