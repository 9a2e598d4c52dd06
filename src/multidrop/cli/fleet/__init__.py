"""The `fleet` command: several gateways for the lines of one plant, by NATS JetStream.

Each action is a command of its own; verbs to drives are those of the commands outside.
"""

ACTIONS = {  # name: module in this package, and help
    "demo": ("demo.command", "kill a gateway of a simulated fleet; show what is missing"),
    "rights": ("rights", "write the servers' configuration, and a key for each user"),
    "init": ("init", "make what is missing in the NATS servers, and store the plant"),
    "serve": ("serve", "run the gateway of this name"),
    "drain": ("drain", "let a gateway give all its lines away"),
    "status": ("look", "say how the gateways are; status 1 where a master is missing"),
    "lines": ("look", "list the lines, and who is master of each since when"),
    "watch": ("watch", "show the fleet live on a terminal"),
    "stop": ("commands", "stop drives, or all of them; asks nobody"),
    "coast": ("commands", "take the voltage off and let a motor run out; asks nobody"),
    "emergency-stop": ("commands", "stop a drive by its own emergency stop; asks nobody"),
    "write": ("commands", "write one register of a drive"),
    "set-frequency": ("commands", "write a drive's frequency setpoint"),
    "start": ("commands", "start a drive's motor"),
    "jog": ("commands", "turn a drive's motor slowly until it is stopped"),
    "reset-fault": ("commands", "reset a drive's fault; never starts the motor"),
}
