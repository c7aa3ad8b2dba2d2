//! Tools to measure servers: loads, and loops that show the limit of the machine.
//!
//! A load and the loop that it is compared with make the same system calls per request where
//! possible, so that two runs differ only by the server.

#![forbid(unsafe_code)]
#![cfg(target_os = "linux")]

mod bare;
mod bare_once;
mod flood;
mod http;
mod load;
mod load_once;
mod outcome;
mod polite;
mod poller;
mod publish;

use std::time::Duration;

use lexopt::ValueExt;

/// An error that makes a measurement worthless.
pub type Failure = Box<dyn std::error::Error>;

/// A run fails if the server does not answer within this time.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Runs the load or the loop that the first argument names. The other arguments are its options.
pub fn main() -> Result<(), Failure> {
    let mut arguments = lexopt::Parser::from_env();
    match arguments.value()?.string()?.as_str() {
        "bare" => bare::main(arguments),
        "bare-once" => bare_once::main(arguments),
        "flood" => flood::main(arguments),
        "load" => load::main(arguments),
        "load-once" => load_once::main(arguments),
        "polite" => polite::main(arguments),
        "publish" => publish::main(arguments),
        other => Err(format!("unknown load or loop {other}").into()),
    }
}

/// Passes each option to `set`, which returns whether the option exists.
fn options(
    mut arguments: lexopt::Parser,
    mut set: impl FnMut(&str, String) -> Result<bool, Failure>,
) -> Result<(), Failure> {
    while let Some(argument) = arguments.next()? {
        let lexopt::Arg::Long(name) = argument else {
            return Err(argument.unexpected().into());
        };
        let name = name.to_owned();
        if !set(&name, arguments.value()?.string()?)? {
            return Err(format!("unknown option --{name}").into());
        }
    }
    Ok(())
}

fn seconds(text: &str) -> Result<Duration, Failure> {
    Ok(Duration::try_from_secs_f64(text.parse()?)?)
}

fn unhex(text: &str) -> Result<Vec<u8>, Failure> {
    if !text.is_ascii() || !text.len().is_multiple_of(2) {
        return Err(format!("not hexadecimal: {text}").into());
    }
    let pairs = (0..text.len()).step_by(2);
    Ok(pairs.map(|at| u8::from_str_radix(&text[at..at + 2], 16)).collect::<Result<_, _>>()?)
}
