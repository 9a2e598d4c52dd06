"""Fleet: several gateways share the lines of a plant through NATS JetStream; each line has one master.

Samples flow from the poller through Spool, Forwarder, the stream `samples` and Hub to Parquet or PostgreSQL.
"""
