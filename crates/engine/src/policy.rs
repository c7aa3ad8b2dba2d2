//! Who may do what: rules, compiled into tables.

use std::net::IpAddr;
use std::sync::Arc;

use holdfast_memory::Memory;
use holdfast_protocol::pdu::Function;
use ipnet::IpNet;

/// What a rule lets its peers do with the memories it names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rights {
    ReadOnly,
    ReadWrite,
}

/// The function codes of a rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Functions {
    All,
    Only(Vec<u8>),
    Except(Vec<u8>),
}

/// What peers from some networks are granted.
#[derive(Debug, Clone)]
pub struct Rule {
    pub sources: Vec<IpNet>,
    pub units: Vec<(u8, Arc<Memory>)>,
    pub rights: Rights,
    pub functions: Functions,
}

/// The rules of a listener: the first whose sources hold a peer settles what it may do.
#[derive(Debug)]
pub struct Policy<G> {
    rules: Vec<(Vec<IpNet>, Arc<G>)>,
}

impl<G> Policy<G> {
    /// Rules as the sources that each holds, and what it grants them.
    pub fn new(rules: impl IntoIterator<Item = (Vec<IpNet>, G)>) -> Policy<G> {
        let rules = rules.into_iter().map(|(sources, grant)| (sources, Arc::new(grant)));
        Policy { rules: rules.collect() }
    }

    /// What a peer is granted; `None` for one that no rule names. An IPv4 address mapped into IPv6
    /// is that IPv4 address.
    pub fn grant(&self, peer: IpAddr) -> Option<&Arc<G>> {
        let peer = peer.to_canonical();
        let mut rules = self.rules.iter();
        rules
            .find(|(sources, _)| sources.iter().any(|network| network.contains(&peer)))
            .map(|(_, grant)| grant)
    }
}

impl Policy<Grant> {
    pub fn of(rules: &[Rule]) -> Policy<Grant> {
        Policy::new(rules.iter().map(|rule| (rule.sources.clone(), Grant::new(rule))))
    }
}

/// One rule as tables.
#[derive(Debug)]
pub struct Grant {
    units: [Option<Arc<Memory>>; 256],
    functions: [bool; 256],
    rights: Rights,
}

impl Grant {
    pub fn new(rule: &Rule) -> Grant {
        let mut units = [const { None }; 256];
        for (unit, memory) in &rule.units {
            units[usize::from(*unit)] = Some(Arc::clone(memory));
        }
        let functions = std::array::from_fn(|code| {
            let code = code as u8;
            let known = Function::from_code(code);
            let named = match &rule.functions {
                Functions::All => true,
                Functions::Only(codes) => codes.contains(&code),
                Functions::Except(codes) => !codes.contains(&code),
            };
            known.is_some_and(|function| {
                named && (rule.rights == Rights::ReadWrite || !function.is_write())
            })
        });
        Grant { units, functions, rights: rule.rights }
    }

    /// The memory behind a unit id.
    #[inline]
    pub fn memory(&self, unit_id: u8) -> Option<&Memory> {
        self.units[usize::from(unit_id)].as_deref()
    }

    /// Unit ids that map every memory behind those that are `wanted`, each memory once.
    pub fn one_unit_of_each_memory(&self, wanted: impl Fn(u8) -> bool) -> Vec<u8> {
        let mut found: Vec<(u8, &Arc<Memory>)> = Vec::new();
        for (unit_id, memory) in (0..=u8::MAX).zip(&self.units) {
            if let Some(memory) = memory
                && wanted(unit_id)
                && !found.iter().any(|(_, known)| Arc::ptr_eq(known, memory))
            {
                found.push((unit_id, memory));
            }
        }
        found.into_iter().map(|(unit_id, _)| unit_id).collect()
    }

    /// Whether a function code is known and allowed.
    #[inline]
    pub fn allows(&self, function_code: u8) -> bool {
        self.functions[usize::from(function_code)]
    }

    pub fn read_only(&self) -> bool {
        self.rights == Rights::ReadOnly
    }
}
