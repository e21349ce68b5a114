"""Our tables of the job database, beside those of DBOS."""

from __future__ import annotations

import sqlalchemy as sa

METADATA = sa.MetaData()
RESULTS = sa.Table(
    "cow_stage_results",
    METADATA,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("job_id", sa.String(64), nullable=False, index=True),
    sa.Column("stage", sa.String(32), nullable=False),
    sa.Column("result", sa.Text, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
)
# The trajectories that jobs computed, by the keys of their stages; results have a mark in their place.
TRAJECTORIES = sa.Table(
    "cow_trajectories",
    METADATA,
    sa.Column("job_id", sa.String(64), primary_key=True),
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("trajectory", sa.LargeBinary, nullable=False),  # JSON, deflated
)
REFERENCES = sa.Table(
    "cow_holds",
    METADATA,
    sa.Column("sha256", sa.String(64), primary_key=True),
    sa.Column("job_id", sa.String(64), primary_key=True, index=True),
)
# The stages of each job that are done, whoever computed their results.
STAGES = sa.Table(
    "cow_job_stages",
    METADATA,
    sa.Column("job_id", sa.String(64), primary_key=True),
    sa.Column("stage", sa.String(32), primary_key=True),
)
# Where the artifacts of all jobs are: one row, once a server has started.
STORES = sa.Table(
    "cow_artifact_store",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),  # always 1
    sa.Column("address", sa.Text, nullable=False),
)
# When a process last began to tidy jobs, and artifacts: a row each. It is not every process's work.
TIDYING = sa.Table(
    "cow_tidying",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),  # 1: jobs; 2: artifacts
    sa.Column("begun", sa.Float, nullable=False),  # Unix time, s
)
# One row for each process that runs an engine.
PROCESSES = sa.Table(
    "cow_processes",
    METADATA,
    sa.Column("executor_id", sa.String(64), primary_key=True),
    sa.Column("seen", sa.Float, nullable=False),  # Unix time of the database, s
    sa.Column("info", sa.Text, nullable=False),  # a `ProcessInfo` as JSON
    sa.Column("waiting", sa.Text, nullable=False),  # ids of jobs that it has taken and not begun, as JSON
)
