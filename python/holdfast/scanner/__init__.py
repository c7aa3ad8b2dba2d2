"""The scanner: polls Modbus devices for subscribers on NATS, and publishes the values.

It has no configuration of devices. It connects to a device at the first subscription to its tags,
and disconnects after the last one ends. It keeps subscriptions over a restart in JetStream only.

`service` makes the parts, connects them and stops them. `requests` carries out subscriptions,
`commands` writes, `reports` answers questions. `placement` is what differs between a scanner that
is alone and a node of a fleet.

* `dialects`: what the programs of each generation send and expect
* `messages`: the messages
* `subscriptions`: devices and tags, who has subscribed to them, and at what rate
* `polling`: the devices in use: their addresses, and how polls and writes reach them
* `publish`: from polls to messages
* `jetstream`: what is kept in JetStream, and what is read there
* `reports`: the answers to `browse` and `variables`
* `fleet`: scanners that share their devices
"""
