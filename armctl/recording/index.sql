-- Tables of the index of a folder of logs (index.py); times are epoch times.
DROP TABLE IF EXISTS logs;
DROP TABLE IF EXISTS events;
DROP TABLE IF EXISTS minutes;
CREATE TABLE logs(
    id INTEGER PRIMARY KEY, name TEXT UNIQUE, size INTEGER, mtime_ns INTEGER, start_s REAL, duration_s REAL, arm_id TEXT,
    version TEXT, simulated INTEGER, complete INTEGER, problem TEXT);
CREATE TABLE events(log INTEGER, time_s REAL, level INTEGER, code TEXT, servo_id INTEGER, text TEXT);
-- A servo by the minute: highest temperature and load, mean load, lowest voltage; mean distance from the goal under torque.
CREATE TABLE minutes(
    log INTEGER, time_s REAL, servo_id INTEGER, joint TEXT, temperature_degC REAL, load_ratio REAL, load_mean_ratio REAL,
    voltage_V REAL, error_deg REAL);
CREATE INDEX events_level ON events(level, log, code);
CREATE INDEX events_code ON events(code);
CREATE INDEX events_log ON events(log);
CREATE INDEX minutes_log ON minutes(log);
-- The levels are those of /rosout: a fault is an error, a note is information.
DROP VIEW IF EXISTS listed;
CREATE VIEW listed AS SELECT logs.*, faults, notes FROM logs
    LEFT JOIN (SELECT log, json_group_array(DISTINCT code) AS faults FROM events WHERE level = 40 GROUP BY log) AS f
        ON f.log = id
    LEFT JOIN (SELECT log, json_group_array(text) AS notes FROM events WHERE code = 'NOTE' AND level = 20 GROUP BY log) AS n
        ON n.log = id
    ORDER BY start_s, name;
DROP VIEW IF EXISTS served;
CREATE VIEW served AS SELECT minutes.*, arm_id, name FROM minutes JOIN logs ON logs.id = log;
