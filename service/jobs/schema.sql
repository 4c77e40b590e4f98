CREATE TABLE IF NOT EXISTS jobs (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,
  owner TEXT NOT NULL,
  folder TEXT NOT NULL UNIQUE,        -- inside <data_dir>/jobs: new for every job, so that no request touches another's files
  state TEXT NOT NULL,
  name TEXT,
  format TEXT,
  options TEXT NOT NULL,
  bytes INTEGER NOT NULL,
  weight INTEGER NOT NULL,            -- points, as estimated before the file is read: what admission counts
  spool INTEGER NOT NULL DEFAULT 0,   -- bytes of its files: while it is not finished, what they may come to
  points INTEGER,
  progress REAL NOT NULL DEFAULT 0,
  attempts INTEGER NOT NULL DEFAULT 0,
  deaths INTEGER NOT NULL DEFAULT 0,  -- of workers that had it, not of servers: a cloud that kills three is given up
  server_deaths INTEGER NOT NULL DEFAULT 0,
  fence INTEGER NOT NULL DEFAULT 0,
  server TEXT,                        -- who works on it
  lease_until REAL,                   -- and until when that is believed: seconds since the machine began
  cancel_requested INTEGER NOT NULL DEFAULT 0,
  created_at REAL NOT NULL,
  started_at REAL,
  finished_at REAL,
  expires_at REAL,
  error TEXT,
  result TEXT,
  report TEXT,
  traceparent TEXT,
  idempotency_key TEXT,
  digest TEXT NOT NULL                -- of the request: the same key or id with another digest is a conflict
);
CREATE INDEX IF NOT EXISTS jobs_by_state ON jobs (state, seq);
CREATE INDEX IF NOT EXISTS jobs_by_owner ON jobs (owner, seq);
CREATE INDEX IF NOT EXISTS jobs_by_end ON jobs (state, expires_at) WHERE expires_at IS NOT NULL;
CREATE UNIQUE INDEX IF NOT EXISTS jobs_by_key ON jobs (owner, idempotency_key) WHERE idempotency_key IS NOT NULL;
CREATE TABLE IF NOT EXISTS events (
  job INTEGER NOT NULL REFERENCES jobs (seq) ON DELETE CASCADE,
  seq INTEGER NOT NULL,
  kind TEXT NOT NULL,
  data TEXT NOT NULL,
  at REAL NOT NULL,
  PRIMARY KEY (job, seq)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS turns (
  owner TEXT PRIMARY KEY,
  at INTEGER NOT NULL                 -- counts the jobs that were taken from the queue: of this owner's last one
) WITHOUT ROWID;
