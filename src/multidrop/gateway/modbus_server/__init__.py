"""The gateway as a Modbus server: over TCP for SCADA systems, and on tool ports for drive vendors' tools."""
