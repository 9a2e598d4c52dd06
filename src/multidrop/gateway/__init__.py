"""The gateway: one process polls the lines, and browsers, brokers and Modbus clients use it."""
