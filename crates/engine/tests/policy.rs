//! Tests which rule applies to a peer, and what it allows.

use std::net::IpAddr;
use std::sync::Arc;

use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::peer_rights::PeerRights;
use holdfast_engine::server::rights::policy::Policy;
use holdfast_engine::server::rights::rule::Rule;
use holdfast_memory::{Layout, Memory};

fn rule(sources: &[&str], unit: u8, rights: AccessMode, functions: Functions) -> Rule {
    Rule {
        sources: sources.iter().map(|source| source.parse().unwrap()).collect(),
        roles: None,
        units: vec![(unit, Arc::new(Memory::new(Layout::default(), None).unwrap()))],
        destinations: Vec::new(),
        access: rights,
        functions,
        narrowed: Vec::new(),
    }
}

fn peer(text: &str) -> IpAddr {
    text.parse().unwrap()
}

fn units_of(rights: Option<Arc<PeerRights>>) -> Option<Vec<u8>> {
    rights.map(|rights| (0..=u8::MAX).filter(|unit| rights.memory(*unit).is_some()).collect())
}

#[test]
fn a_peer_has_the_units_of_all_rules_that_name_it() {
    let policy = Policy::of(&[
        rule(&["10.0.0.0/24", "fd00::/64"], 1, AccessMode::ReadWrite, Functions::All),
        rule(&["10.0.0.0/8"], 2, AccessMode::ReadOnly, Functions::All),
    ]);
    for (address, units) in
        [("10.0.0.255", vec![1, 2]), ("10.0.1.0", vec![2]), ("fd00::ffff", vec![1])]
    {
        assert_eq!(units_of(policy.rights(peer(address), None)), Some(units), "{address}");
    }
    for stranger in ["11.0.0.1", "fd00:0:0:1::1", "::1", "127.0.0.1"] {
        assert_eq!(units_of(policy.rights(peer(stranger), None)), None, "{stranger}");
    }
}

#[test]
fn the_first_rule_that_names_peer_and_unit_decides() {
    let first = rule(&["10.0.0.7/32"], 1, AccessMode::ReadWrite, Functions::Only(vec![3, 6]));
    let policy = Policy::of(&[
        first.clone(),
        rule(&["10.0.0.0/8"], 1, AccessMode::ReadOnly, Functions::All),
        rule(&["10.0.0.0/8"], 2, AccessMode::ReadOnly, Functions::Only(vec![4])),
    ]);
    let rights = policy.rights(peer("10.0.0.7"), None).unwrap();
    assert!(std::ptr::eq(rights.memory(1).unwrap(), Arc::as_ptr(&first.units[0].1)));
    let allowed =
        |unit| -> Vec<u8> { (0..=255).filter(|code| rights.allows(unit, *code)).collect() };
    assert_eq!((allowed(1), allowed(2)), (vec![3, 6], vec![4]));
    // A unit that the peer does not have shows what it may do elsewhere.
    assert_eq!(allowed(3), [3, 4, 6]);
    assert!(!rights.is_read_only(1) && rights.is_read_only(2) && rights.is_read_only(3));
    let other = policy.rights(peer("10.0.0.8"), None).unwrap();
    assert!(!other.allows(1, 6) && other.allows(1, 1));
    assert!(Arc::ptr_eq(&rights, &policy.rights(peer("10.0.0.7"), None).unwrap()));
}

#[test]
fn rules_apply_to_roles() {
    let of_roles = |roles: &[&str], rule: Rule| Rule {
        roles: Some(roles.iter().map(|role| (*role).to_owned()).collect()),
        ..rule
    };
    let policy = Policy::of(&[
        of_roles(&["a", "b"], rule(&["10.0.0.0/8"], 1, AccessMode::ReadWrite, Functions::All)),
        of_roles(&["b", ""], rule(&["10.0.0.0/24"], 2, AccessMode::ReadOnly, Functions::All)),
        rule(&["10.0.1.0/24"], 3, AccessMode::ReadOnly, Functions::All),
    ]);
    for (address, role, units) in [
        ("10.0.0.1", "a", Some(vec![1])),
        ("10.0.0.1", "b", Some(vec![1, 2])),
        ("10.0.0.1", "", Some(vec![2])),
        ("10.0.0.1", "A", None),
        ("10.0.1.1", "", Some(vec![3])),
        ("10.0.1.1", "x", Some(vec![3])),
        ("10.0.2.1", "x", None),
        ("11.0.0.1", "a", None),
    ] {
        let rights = policy.rights(peer(address), Some(role));
        assert_eq!(units_of(rights), units, "{address} {role:?}");
    }
    assert!(policy.rights(peer("10.0.2.1"), None).is_some());
    assert!(policy.rights(peer("11.0.0.1"), None).is_none());
}

#[test]
fn an_ipv4_mapped_address_is_treated_as_ipv4() {
    let rules = vec![rule(&["10.0.0.0/24"], 1, AccessMode::ReadOnly, Functions::All)];
    assert!(Policy::of(&rules).rights(peer("::ffff:10.0.0.7"), None).is_some());
    let rules = vec![rule(&["::/0"], 1, AccessMode::ReadOnly, Functions::All)];
    assert!(Policy::of(&rules).rights(peer("::ffff:10.0.0.7"), None).is_none());
}

#[test]
fn a_function_must_be_known_listed_and_within_the_access_mode() {
    let allowed = |rights, functions| -> Vec<u8> {
        let policy = Policy::of(&[rule(&["::/0"], 1, rights, functions)]);
        let rights = policy.rights(peer("::1"), None).unwrap();
        (0..=255).filter(|code| rights.allows(1, *code)).collect()
    };
    let all = [1, 2, 3, 4, 5, 6, 8, 11, 12, 15, 16, 17, 22, 23, 43];
    assert_eq!(allowed(AccessMode::ReadWrite, Functions::All), all);
    assert_eq!(allowed(AccessMode::ReadOnly, Functions::All), [1, 2, 3, 4, 8, 11, 12, 17, 43]);
    assert_eq!(allowed(AccessMode::ReadOnly, Functions::Only(vec![3, 6, 99])), [3]);
    assert_eq!(allowed(AccessMode::ReadWrite, Functions::Only(vec![3, 6, 99])), [3, 6]);
    let except = Functions::Except(vec![3, 43]);
    assert_eq!(allowed(AccessMode::ReadOnly, except), [1, 2, 4, 8, 11, 12, 17]);
}

#[test]
fn a_peer_without_rights_may_do_nothing() {
    let nobody = PeerRights::none();
    for unit_id in 0..=u8::MAX {
        assert!(nobody.memory(unit_id).is_none());
        assert!((0..=u8::MAX).all(|code| !nobody.allows(unit_id, code)));
        assert!(nobody.is_read_only(unit_id));
    }
}
