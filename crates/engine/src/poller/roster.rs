//! What belongs to each device, by its name and in the order in which the devices were added.

use std::collections::{BTreeMap, HashMap};

pub(super) struct Roster<D> {
    /// By a number that grows.
    devices: BTreeMap<u64, D>,
    numbers: HashMap<String, u64>,
    next: u64,
}

impl<D> Default for Roster<D> {
    fn default() -> Roster<D> {
        Roster { devices: BTreeMap::new(), numbers: HashMap::new(), next: 0 }
    }
}

impl<D> Roster<D> {
    pub fn has(&self, name: &str) -> bool {
        self.numbers.contains_key(name)
    }

    pub fn get(&self, name: &str) -> Option<&D> {
        self.devices.get(self.numbers.get(name)?)
    }

    /// Adds a device, whose name no other one has.
    pub fn add(&mut self, name: String, device: D) {
        let before = self.numbers.insert(name, self.next);
        assert!(before.is_none(), "the name of a device is not in use");
        self.devices.insert(self.next, device);
        self.next += 1;
    }

    /// Puts a device in the place of another one. No third one has its name.
    pub fn replace(&mut self, name: &str, by: String, device: D) {
        let number = self.numbers.remove(name).expect("there is a device to be replaced");
        let before = self.numbers.insert(by, number);
        assert!(before.is_none(), "the name of a device is not in use");
        self.devices.insert(number, device);
    }

    /// Returns whether there was a device of that name.
    pub fn remove(&mut self, name: &str) -> bool {
        let removed = self.numbers.remove(name).and_then(|number| self.devices.remove(&number));
        removed.is_some()
    }

    pub fn iter(&self) -> impl Iterator<Item = &D> {
        self.devices.values()
    }
}
