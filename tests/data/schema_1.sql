-- The tables of schema 1, as the first version with `cow_jobs` made them. For PostgreSQL, BLOB is BYTEA.
CREATE TABLE cow_artifact_store (
    id INTEGER NOT NULL,
    address TEXT NOT NULL,
    PRIMARY KEY (id)
);
CREATE TABLE cow_executors (
    executor VARCHAR(64) NOT NULL,
    seen FLOAT NOT NULL,
    info TEXT NOT NULL,
    PRIMARY KEY (executor)
);
CREATE TABLE cow_jobs (
    id VARCHAR(64) NOT NULL,
    kind VARCHAR(16) NOT NULL,
    owner TEXT,
    status VARCHAR(16) NOT NULL,
    created_at VARCHAR(32) NOT NULL,
    ended FLOAT,
    version VARCHAR(16) NOT NULL,
    queue VARCHAR(64) NOT NULL,
    priority VARCHAR(16) NOT NULL,
    turn INTEGER NOT NULL,
    executor VARCHAR(64),
    run VARCHAR(64),
    starts INTEGER NOT NULL,
    generator TEXT NOT NULL,
    question TEXT NOT NULL,
    image VARCHAR(64) NOT NULL,
    webhook TEXT,
    spec BLOB NOT NULL,
    format INTEGER,
    result BLOB,
    trajectory_key VARCHAR(64),
    error TEXT,
    PRIMARY KEY (id)
);
CREATE INDEX cow_jobs_ended ON cow_jobs (ended);
CREATE INDEX cow_jobs_of_owner ON cow_jobs (owner, created_at);
CREATE INDEX cow_jobs_of_status ON cow_jobs (status, created_at);
CREATE INDEX cow_jobs_of_time ON cow_jobs (created_at);
CREATE TABLE cow_maintenance (
    task VARCHAR(16) NOT NULL,
    begun FLOAT NOT NULL,
    PRIMARY KEY (task)
);
CREATE TABLE cow_references (
    sha256 VARCHAR(64) NOT NULL,
    job_id VARCHAR(64) NOT NULL,
    PRIMARY KEY (sha256, job_id),
    FOREIGN KEY(job_id) REFERENCES cow_jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_cow_references_job_id ON cow_references (job_id);
CREATE TABLE cow_results (
    "key" VARCHAR(64) NOT NULL,
    job_id VARCHAR(64) NOT NULL,
    stage VARCHAR(32) NOT NULL,
    result BLOB NOT NULL,
    created_at FLOAT NOT NULL,
    PRIMARY KEY ("key"),
    FOREIGN KEY(job_id) REFERENCES cow_jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_cow_results_job_id ON cow_results (job_id);
CREATE TABLE cow_stages_of_jobs (
    job_id VARCHAR(64) NOT NULL,
    stage VARCHAR(32) NOT NULL,
    PRIMARY KEY (job_id, stage),
    FOREIGN KEY(job_id) REFERENCES cow_jobs (id) ON DELETE CASCADE
);
CREATE TABLE cow_trajectories_of_jobs (
    job_id VARCHAR(64) NOT NULL,
    "key" VARCHAR(64) NOT NULL,
    trajectory BLOB NOT NULL,
    PRIMARY KEY (job_id, "key"),
    FOREIGN KEY(job_id) REFERENCES cow_jobs (id) ON DELETE CASCADE
);
