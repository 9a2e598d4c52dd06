"""Live data of the drives: their newest values, the frames sent to pages, triggers and alarms."""
