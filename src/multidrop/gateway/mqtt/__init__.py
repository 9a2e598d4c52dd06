"""The gateway's MQTT interface: JSON topics, Home Assistant and Sparkplug."""
