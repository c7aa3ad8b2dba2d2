//! The identification of the units of a listener: functions 17 and 43/14.

use std::collections::HashMap;

use holdfast_protocol::pdu::identification::{ObjectError, Objects};
use holdfast_protocol::pdu::reply::MAX_SERVER_ID_LEN;

/// The object that the name of a unit replaces.
const USER_APPLICATION_NAME: u8 = 0x06;

/// Server id and run indicator take one byte each.
const MAX_TEXT_BYTES: usize = MAX_SERVER_ID_LEN - 2;

/// The identification of every unit.
#[derive(Debug)]
pub struct Identity {
    all: Card,
    named: HashMap<u8, Card>,
}

/// The identification of one unit.
#[derive(Debug)]
pub struct Card {
    pub objects: Objects,
    /// The additional data of Report Server ID.
    pub text: Box<[u8]>,
}

impl Identity {
    /// `objects` are the identification objects by id, `unit_names` the names of single units.
    ///
    /// # Errors
    /// [`ObjectError`] for objects that cannot be served.
    pub fn new(
        objects: &[(u8, Vec<u8>)],
        unit_names: &[(u8, Vec<u8>)],
    ) -> Result<Identity, ObjectError> {
        let named = unit_names.iter().map(|(unit, name)| {
            let own = (USER_APPLICATION_NAME, name.clone());
            let others = objects.iter().filter(|(id, _)| *id != USER_APPLICATION_NAME).cloned();
            Ok((*unit, Card::new(others.chain([own]).collect(), Some(name))?))
        });
        Ok(Identity {
            all: Card::new(objects.to_vec(), None)?,
            named: named.collect::<Result<_, _>>()?,
        })
    }

    pub fn card(&self, unit_id: u8) -> &Card {
        self.named.get(&unit_id).unwrap_or(&self.all)
    }
}

impl Card {
    fn new(objects: Vec<(u8, Vec<u8>)>, name: Option<&[u8]>) -> Result<Card, ObjectError> {
        let objects = objects.into_iter().map(|(id, value)| (id, value.into_boxed_slice()));
        let objects = Objects::new(objects)?;
        let product = [0x00, 0x01, 0x02].map(|id| objects.get(id).unwrap_or_default()).join(&b' ');
        let mut text = name.unwrap_or(&product).to_vec();
        text.truncate(MAX_TEXT_BYTES);
        Ok(Card { objects, text: text.into() })
    }
}
