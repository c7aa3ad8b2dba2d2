"""A simulated device: live values for the tags of a list, and faults on request.

`device` has the device, `generators` what its values do, `faults` a front that delays, drops and
refuses requests.
"""
