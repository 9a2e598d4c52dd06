"""What the gateway shows live: frames, events, alarms and views of the drives."""
