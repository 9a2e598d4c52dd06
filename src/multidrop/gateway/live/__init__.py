"""Live data of the drives: frames, events, alarms and views."""
