"""The gateway: one process that polls the lines and serves the values to browsers, brokers and Modbus
clients.
"""
