"""OPC UA server: each drive is an object with its values, their units, and a method that stops the drive."""

# names of the nodes that each drive has in addition to its registers
STATE, FAULT, STOP = MEMBERS = ("State", "Fault", "Stop")
# names of OPC UA properties that the nodes of registers and of STOP have
PROPERTIES = UNIT, RESULTS = ("EngineeringUnits", "OutputArguments")
