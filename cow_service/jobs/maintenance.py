"""What an engine does now and then: tells ends, sees cancellations by others, takes over from the dead, tidies up."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from dbos import DBOS
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import CowError
from cow_service.jobs import reports
from cow_service.jobs.executors import Executors
from cow_service.jobs.ledger import Ledger

SETTLE = 0.005  # seconds between looks at whether the database has the end of a job
SETTLING = 30.0  # seconds after which nobody looks any more
LOOK = 1.0  # seconds between looks at jobs that run here
RECOUNT = 10.0  # seconds
TIDY = 600.0  # seconds
GRACE = 3600.0  # seconds that an artifact is kept without a job: somebody may be about to send it with one
TAKING = 5.0  # seconds in which the database has taken a job that holds its image
AT_ONCE = 200  # jobs removed in one go
LONGEST_STOP = 5.0  # seconds

log = logging.getLogger("cow_service")


class Upkeep:
    """Two threads beside an engine's own."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._settling: dict[str, float] = {}
        self._new = threading.Event()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._idle: set[str] = set()  # jobs of this process on which nobody worked at the last look

    def start(self, executors: Executors) -> None:
        """Starts the threads."""
        self._stop.clear()
        for work, name in ((self._settle_all, "cow-settle"), (lambda: self._keep_up(executors), "cow-upkeep")):
            thread = threading.Thread(target=work, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """Ends the threads."""
        self._stop.set()
        self._new.set()
        for thread in self._threads:
            thread.join(LONGEST_STOP)  # one that waits for a database that is away does not keep the process
        self._threads.clear()

    def settle(self, job_id: str) -> None:
        """Has the end of a job told as soon as the database has it."""
        self._settling[job_id] = time.monotonic() + SETTLING
        self._new.set()

    def tidy(self) -> None:
        """Removes jobs that ended long ago, and artifacts that no job holds."""
        ledger = self._ledger
        before = datetime.now(UTC) - timedelta(hours=ledger.service.settings.job_retention_hours)
        while not self._stop.is_set() and (jobs := reports.ended_before(before, AT_ONCE)):
            ledger.remove(jobs, before.timestamp())
        kept = ledger.database.jobs()
        for start in range(0, len(kept), AT_ONCE):  # of jobs that were deleted while they ran
            if self._stop.is_set():
                return
            some = kept[start : start + AT_ONCE]
            missing = set(some) - reports.existing(some)
            # One that is just being taken holds its image a moment before the database has it.
            if missing and not self._stop.wait(TAKING):
                ledger.database.forget(sorted(missing - reports.existing(sorted(missing))))
        moment = time.time() - GRACE
        loose = list(ledger.service.artifacts.untouched_since(moment))
        held = ledger.database.held(loose)
        removed = sum(ledger.service.artifacts.delete(one, moment) for one in loose if one not in held)
        if removed:
            log.info("removed %d artifacts that no job holds", removed)

    def _settle_all(self) -> None:
        while self._new.wait() and not self._stop.is_set():
            self._new.clear()
            while self._settling and not self._stop.wait(SETTLE):
                if not self._guarded(self._settle_some):
                    self._stop.wait(LOOK)

    def _settle_some(self) -> None:
        now = time.monotonic()
        for job_id, until in list(self._settling.items()):
            if now > until:
                del self._settling[job_id]  # whoever waits looks for themselves now and then
                self._ledger.live.forget(job_id)
                continue
            found = reports.find(job_id, self._ledger.live, full=False)
            if found is None or found.ended is not None:
                self._ledger.ended(job_id, None)
                del self._settling[job_id]

    def _keep_up(self, executors: Executors) -> None:
        counted = tidied = time.monotonic()  # jobs that were cut off take hold of their artifacts before anybody tidies
        self._guarded(lambda: self._take_over(executors))
        while not self._stop.wait(LOOK):
            now = time.monotonic()
            self._guarded(self._see_cancellations)
            if now - counted > RECOUNT:
                counted = now
                self._guarded(lambda: self._take_over(executors))
                self._guarded(self._revive)
                self._guarded(self._ledger.recount)
            if now - tidied > TIDY:
                tidied = now
                self._guarded(self.tidy)

    def _see_cancellations(self) -> None:
        """Another process may have canceled or deleted a job that runs here."""
        for job_id in self._ledger.live.jobs():
            found = reports.find(job_id, self._ledger.live, full=False)
            if found is None or found.job.status == "canceled":
                self._ledger.live.end(job_id)

    def _take_over(self, executors: Executors) -> None:
        """Has the jobs that were under way in processes that have ended begin again, in any that runs."""
        for name, lock in executors.dead():
            try:
                # What DBOS does at its own start: a job that was canceled meanwhile stays so, and each start counts.
                for handle in DBOS._recover_pending_workflows([name]):  # pyright: ignore[reportPrivateUsage]
                    log.info("taking over %s", handle.get_workflow_id())
            finally:
                lock.release()

    def _revive(self) -> None:
        """Has jobs of this process begin again on which nobody works: their end could not be written, say."""
        pending = DBOS.list_workflows(
            name=list(reports.KINDS),
            status="PENDING",
            executor_id=DBOS.executor_id,
            load_input=False,
            load_output=False,
        )
        idle = {one.workflow_id for one in pending} - set(self._ledger.live.jobs())
        for job_id in idle & self._idle:  # also a while ago: it is not just being started
            log.warning("job %s was left alone, and begins again", job_id)
            DBOS.resume_workflow(job_id)
        self._idle = idle

    def _guarded(self, work: Callable[[], None]) -> bool:
        """Whether work went well. Upkeep goes on whatever happens: nobody would do it instead."""
        try:
            work()
        except (CowError, dbos_error.DBOSException, SQLAlchemyError) as error:
            log.warning("upkeep: %s", getattr(error, "detail", type(error).__name__))
            return False
        except Exception:
            log.exception("upkeep failed")
            return False
        return True
