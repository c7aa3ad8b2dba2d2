"""Runs the appliance under test, with the configuration file in the first argument."""

from __future__ import annotations

import sys

from holdfast import config
from holdfast.appliance import Appliance
from holdfast.appliance.supervision import give_way

give_way()
with Appliance(config.load(sys.argv[1])) as appliance:
    for endpoint in appliance.endpoints():
        print(f"listening {endpoint.name} {endpoint.host}:{endpoint.port}", flush=True)
    sys.stdin.read()
