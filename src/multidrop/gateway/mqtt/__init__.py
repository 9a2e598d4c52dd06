"""The gateway's MQTT interface: JSON topics, Home Assistant's discovery, and Sparkplug."""
