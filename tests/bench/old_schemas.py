"""The tables of runs that older benches wrote, as they were: these texts never change."""

VERSION_1 = """
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE events (number INTEGER PRIMARY KEY, t_s REAL, kind TEXT NOT NULL, text TEXT NOT NULL, wall_time TEXT NOT NULL);
CREATE TABLE bath (t_s REAL PRIMARY KEY, temp_c REAL NOT NULL, external_c REAL, power_percent REAL, state TEXT NOT NULL);
CREATE TABLE trials (id TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, situation TEXT NOT NULL, repeat INTEGER NOT NULL,
  started_s REAL, ended_s REAL, captured_s REAL, bath_c REAL, bath_state TEXT, note TEXT, wall_time TEXT NOT NULL);
CREATE TABLE frames (trial TEXT NOT NULL REFERENCES trials, camera TEXT NOT NULL, path TEXT NOT NULL, sha256 TEXT NOT NULL, exposed_s REAL,
  PRIMARY KEY (trial, camera));
CREATE TABLE touches (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL, touch INTEGER NOT NULL, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, spread_mm REAL NOT NULL, packets INTEGER NOT NULL, counts TEXT NOT NULL,
  PRIMARY KEY (trial, teat, touch));
CREATE TABLE truth (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, u_mm REAL, visible INTEGER NOT NULL, exact_mm TEXT,
  PRIMARY KEY (trial, teat));
CREATE TABLE detections (trial TEXT NOT NULL REFERENCES trials, detector TEXT NOT NULL, hidden INTEGER NOT NULL, reason TEXT,
  trace TEXT NOT NULL, wall_seconds REAL NOT NULL, PRIMARY KEY (trial, detector));
CREATE TABLE found (trial TEXT NOT NULL, detector TEXT NOT NULL, number INTEGER NOT NULL, x_mm REAL NOT NULL, y_mm REAL NOT NULL,
  z_mm REAL NOT NULL, covariance_mm2 TEXT, left_px TEXT, right_px TEXT, PRIMARY KEY (trial, detector, number),
  FOREIGN KEY (trial, detector) REFERENCES detections);
CREATE TABLE scores (trial TEXT NOT NULL, detector TEXT NOT NULL, score TEXT NOT NULL, wall_score TEXT NOT NULL,
  PRIMARY KEY (trial, detector), FOREIGN KEY (trial, detector) REFERENCES detections);
"""

VERSION_2 = """
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE events (number INTEGER PRIMARY KEY, t_s REAL, kind TEXT NOT NULL, text TEXT NOT NULL, wall_time TEXT NOT NULL);
CREATE TABLE bath (t_s REAL PRIMARY KEY, temp_c REAL NOT NULL, external_c REAL, power_percent REAL, state TEXT NOT NULL);
CREATE TABLE trials (id TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, situation TEXT NOT NULL, repeat INTEGER NOT NULL,
  started_s REAL, ended_s REAL, captured_s REAL, bath_c REAL, bath_state TEXT, note TEXT,
  stage_mm TEXT, invalid TEXT, wall_time TEXT NOT NULL);
CREATE TABLE skipped (trial TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, situation TEXT NOT NULL, repeat INTEGER NOT NULL,
  t_s REAL NOT NULL, reason TEXT NOT NULL);
CREATE TABLE frames (trial TEXT NOT NULL REFERENCES trials, camera TEXT NOT NULL, path TEXT NOT NULL, sha256 TEXT NOT NULL, exposed_s REAL,
  PRIMARY KEY (trial, camera));
CREATE TABLE touches (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL, touch INTEGER NOT NULL, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, spread_mm REAL NOT NULL, packets INTEGER NOT NULL, counts TEXT NOT NULL,
  refused TEXT,
  PRIMARY KEY (trial, teat, touch));
CREATE TABLE truth (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, u_mm REAL, visible INTEGER NOT NULL, exact_mm TEXT,
  how TEXT, budget TEXT, covariance_mm2 TEXT, PRIMARY KEY (trial, teat));
CREATE TABLE checks (number INTEGER NOT NULL, teat TEXT NOT NULL, after_trial TEXT NOT NULL REFERENCES trials, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, carried_x_mm REAL NOT NULL, carried_y_mm REAL NOT NULL,
  carried_z_mm REAL NOT NULL, off_mm REAL NOT NULL, limit_mm REAL NOT NULL, held INTEGER NOT NULL, PRIMARY KEY (number, teat));
CREATE TABLE detections (trial TEXT NOT NULL REFERENCES trials, detector TEXT NOT NULL, hidden INTEGER NOT NULL, reason TEXT,
  outcome TEXT NOT NULL DEFAULT 'answered', cold INTEGER NOT NULL DEFAULT 0, trace TEXT NOT NULL,
  wall_seconds REAL NOT NULL, wall_start_up_s REAL, wall_stderr TEXT, PRIMARY KEY (trial, detector));
CREATE TABLE found (trial TEXT NOT NULL, detector TEXT NOT NULL, number INTEGER NOT NULL, x_mm REAL NOT NULL, y_mm REAL NOT NULL,
  z_mm REAL NOT NULL, covariance_mm2 TEXT, left_px TEXT, right_px TEXT, PRIMARY KEY (trial, detector, number),
  FOREIGN KEY (trial, detector) REFERENCES detections);
CREATE TABLE scores (trial TEXT NOT NULL, detector TEXT NOT NULL, score TEXT NOT NULL, wall_score TEXT NOT NULL,
  PRIMARY KEY (trial, detector), FOREIGN KEY (trial, detector) REFERENCES detections);
"""

ROWS_1 = """
INSERT INTO facts VALUES ('detectors', '["thesis"]'), ('title', '"old"'), ('ending', '"finished"');
INSERT INTO events VALUES (1, 0.5, 'state', 'preparing', '2026-10-01T08:00:00.000+00:00'),
  (2, NULL, 'end', 'finished', '2026-10-01T08:10:00.000+00:00');
INSERT INTO bath VALUES (1.0, 32.5, NULL, 4.0, 'settling'), (2.0, 33.0, NULL, 3.0, 'stable');
INSERT INTO trials (id, number, name, situation, repeat, started_s, ended_s, captured_s, bath_c, bath_state, wall_time)
  VALUES ('001-x-1', 1, 'x', 's', 1, 3.0, 5.0, 4.0, 33.0, 'stable', '2026-10-01T08:05:00.000+00:00'),
         ('002-y-1', 2, 'y', 's', 1, 6.0, 8.0, 7.0, 33.0, 'stable', '2026-10-01T08:06:00.000+00:00');
INSERT INTO frames VALUES ('001-x-1', 'left', 'frames/001-x-1/left.png', '00', 4.0);
INSERT INTO touches (trial, teat, touch, t_s, x_mm, y_mm, z_mm, spread_mm, packets, counts)
  VALUES ('001-x-1', '1', 1, 4.5, 1.0, 2.0, 3.0, 0.1, 40, '[1, 2]');
INSERT INTO truth (trial, teat, x_mm, y_mm, z_mm, u_mm, visible) VALUES ('001-x-1', '1', 1.0, 2.0, 3.0, 0.2, 1);
INSERT INTO detections (trial, detector, hidden, reason, trace, wall_seconds) VALUES ('001-x-1', 'thesis', 0, NULL, '{}', 0.1);
INSERT INTO found VALUES ('001-x-1', 'thesis', 1, 1.5, 2.0, 3.0, NULL, NULL, NULL);
"""

ROWS_2 = (
    ROWS_1
    + """
UPDATE trials SET invalid = 'the carried end was off', stage_mm = '[1.0, 2.0, 3.0]' WHERE number = 2;
UPDATE truth SET how = 'touched';
INSERT INTO skipped VALUES ('003-z-1', 3, 'z', 's', 1, 9.0, 'no teat to touch');
INSERT INTO checks VALUES (1, '1', '002-y-1', 8.5, 1.0, 2.0, 3.0, 1.0, 2.0, 9.0, 6.0, 1.0, 0);
UPDATE detections SET outcome = 'timeout', cold = 1;
"""
)
