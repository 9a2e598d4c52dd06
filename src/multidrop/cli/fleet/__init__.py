"""`multidrop fleet`: several gateways share the lines of one plant through NATS JetStream.

An action has the name of the similar command for a plant without a fleet, if there is one.
"""

ACTIONS = {  # each action's module in this package, and its help text
    "demo": ("demo", "kill a gateway of a simulated fleet and show the takeover"),
    "rights": ("setup", "write the servers' configuration, and a key for each user"),
    "init": ("setup", "set the NATS servers up, and store the plant"),
    "serve": ("gateway", "run the gateway with this name"),
    "drain": ("gateway", "move all lines of a gateway to the others"),
    "status": ("views", "show all gateways; exit status 1 if a line is not polled"),
    "lines": ("views", "list the lines with their masters"),
    "watch": ("views", "show the fleet live on a terminal"),
    "stop": ("commands", "stop drives, or all of them, without confirmation"),
    "coast": ("commands", "let a motor coast to a stop, without confirmation"),
    "emergency-stop": ("commands", "use a drive's emergency stop, without confirmation"),
    "write": ("commands", "write one register of a drive"),
    "set-frequency": ("commands", "write a drive's frequency setpoint"),
    "start": ("commands", "start a drive's motor"),
    "jog": ("commands", "turn a drive's motor slowly until it is stopped"),
    "reset-fault": ("commands", "reset a drive's fault; never starts the motor"),
}
