"""The table of readings that both Delixi protocols share."""

from __future__ import annotations

MONITORS = """
01F4 output_frequency     0.01 Hz
01F5 reference_frequency  ? Hz
01F6 output_current       ? A
01F7 output_voltage       ? V
01F8 dc_bus_voltage       ? V
01F9 io_signals           1
01FA closed_loop_setpoint ?
01FB closed_loop_feedback ?
01FC heatsink_temperature ? °C
01FD synchronous_speed    ? rpm
01FE motor_speed          ? rpm
01FF counter              1
0200 length               ?
0201 set_length           ?
0202 overload             ?
0203 stage                1
0204 stage_time           ?
0205 stage_time_left      ?
0206 work_time            ?
0207 energy_high          ?
0208 energy_low           ?
0209 vf1_input            ?
020A vf2_input            ?
020B vf1_transformed      ?
020C vf2_transformed      ?
020D fault_record_1       1
020E fault_record_2       1
020F fault_record_3       1
0210 fault_record_4       1
0211 overcurrent_record   ?
0212 overvoltage_record   ?
0213 fault                - DelixiFault
0000 run_source           - DelixiRunSource
0001 frequency_source     1
01AC baudrate_setting     - DelixiBaudrate
01AD format_setting       - DelixiModbusFormat
01AE address_setting      1
"""
