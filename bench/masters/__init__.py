"""The Modbus masters to compare: multidrop, other libraries, and minimal programs in C."""
