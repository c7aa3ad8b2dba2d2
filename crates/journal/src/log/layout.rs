//! The layout of the memories of a log as text, which all its nodes must share.

use std::collections::BTreeMap;
use std::sync::Arc;

use holdfast_memory::{Gate, GateMode, Memory};

/// A line for each memory, in the order of their names: name, areas with first address and size,
/// seal.
pub(super) fn fingerprint(members: &[(String, Arc<Memory>)]) -> String {
    let lines: Vec<String> =
        members.iter().map(|(name, memory)| format!("{name}: {}", described(memory))).collect();
    lines.join("\n")
}

fn described(memory: &Memory) -> String {
    let areas = memory.layout().areas().filter(|area| memory.span(*area).size() > 0);
    let mut parts: Vec<String> = areas
        .map(|area| {
            let span = memory.span(area);
            format!("{} {}+{}", area.name(), span.start(), span.size())
        })
        .collect();
    if let Some(Gate { area, address, mode }) = memory.gate() {
        let mode = match mode {
            GateMode::Once => "once",
            GateMode::Level => "level",
        };
        parts.push(format!("seal {} {address} {mode}", area.name()));
    }
    parts.join(", ")
}

/// The first difference between two fingerprints, for a message.
pub(super) fn difference(log: &str, here: &str) -> Option<String> {
    let parts = |text: &str| -> BTreeMap<String, String> {
        let lines = text.lines().filter_map(|line| line.split_once(": "));
        lines.map(|(name, of)| (name.to_owned(), of.to_owned())).collect()
    };
    let (log, here) = (parts(log), parts(here));
    for (name, of) in &log {
        match here.get(name) {
            None => return Some(format!("the log has memory {name:?} ({of}), this node has not")),
            Some(mine) if mine != of => {
                return Some(format!("memory {name:?} is {of} in the log, here it is {mine}"));
            }
            Some(_) => {}
        }
    }
    let extra = here.iter().find(|(name, _)| !log.contains_key(*name));
    extra.map(|(name, of)| format!("this node has memory {name:?} ({of}), the log has not"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_difference_is_named() {
        let log = "a: coils 0+8\nb: holding_registers 0+10";
        let differs = |here: &str| difference(log, here).unwrap();
        assert_eq!(difference(log, log), None);
        assert!(
            differs("a: coils 0+8").contains("memory \"b\" (holding_registers 0+10), this node")
        );
        let resized = differs("a: coils 0+9\nb: holding_registers 0+10");
        assert_eq!(resized, "memory \"a\" is coils 0+8 in the log, here it is coils 0+9");
        let more = format!("{log}\nc: coils 0+1");
        assert!(differs(&more).contains("this node has memory \"c\" (coils 0+1)"));
    }
}
