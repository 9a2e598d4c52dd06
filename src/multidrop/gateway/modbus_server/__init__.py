"""The gateway as a Modbus TCP server for SCADA systems."""
