"""The parts of a running appliance, each with the state and the methods of `part.Part`."""
