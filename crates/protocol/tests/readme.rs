//! Checks that the README describes the crate.

use holdfast_protocol::pdu::{Function, SubFunction, limit};

const README: &str = include_str!("../README.md");

/// The cells of the table of functions, row by row.
fn rows() -> Vec<Vec<&'static str>> {
    let table = README.split("| code | function | quantity |\n").nth(1).unwrap();
    let rows = table.lines().skip(1).take_while(|line| line.starts_with('|'));
    rows.map(|row| row.trim_matches('|').split('|').map(str::trim).collect()).collect()
}

#[test]
fn the_table_names_every_function() {
    let named: Vec<_> = rows().iter().map(|row| (row[0].to_owned(), row[1])).collect();
    let all: Vec<_> =
        Function::ALL.iter().map(|each| (each.code().to_string(), each.name())).collect();
    assert_eq!(named, all);
}

#[test]
fn the_table_gives_the_limits_of_each_function() {
    let limits = [
        (1, format!("1-{}", limit::READ_BITS)),
        (2, format!("1-{}", limit::READ_BITS)),
        (3, format!("1-{}", limit::READ_REGISTERS)),
        (4, format!("1-{}", limit::READ_REGISTERS)),
        (8, format!("{} sub-functions: 0-4, 10-18, 20", SubFunction::ALL.len())),
        (15, format!("1-{}", limit::WRITE_BITS)),
        (16, format!("1-{}", limit::WRITE_REGISTERS)),
        (20, format!("1-{} in one range", limit::READ_RECORDS)),
        (21, format!("1-{} in one range", limit::WRITE_RECORDS)),
        (24, format!("a reply has 0-{}", limit::QUEUE_REGISTERS)),
        (23, format!("read 1-{}, write 1-{}", limit::READ_REGISTERS, limit::READ_WRITE_REGISTERS)),
    ];
    for (code, quantity) in limits {
        let row = rows().into_iter().find(|row| row[0] == code.to_string()).unwrap();
        assert_eq!(row[2], quantity);
    }
}

#[test]
fn the_minimum_rust_version_is_the_one_of_the_manifest() {
    let version = env!("CARGO_PKG_RUST_VERSION");
    assert!(README.contains(&format!("requires Rust {version} or newer")));
}
