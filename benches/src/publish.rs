//! A bare publisher to NATS JetStream: each of some publishers sends its next message when the last
//! one is acknowledged.

use std::cell::RefCell;
use std::time::Instant;

use async_nats::jetstream::{self, stream};

use crate::outcome::{Outcome, Period};
use crate::{Failure, options};

/// As large as the message of a write of one register.
const PAYLOAD: &[u8] = &[0; 45];

/// `--url U --publishers P --warmup S --seconds S`.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let (mut url, mut publishers, mut period) = (String::new(), 64, Period::DEFAULT);
    options(arguments, |name, value| {
        match name {
            "url" => url = value,
            "publishers" => publishers = value.parse()?,
            _ => return period.set(name, &value),
        }
        Ok(true)
    })?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(publish(&url, publishers, period))
}

async fn publish(url: &str, publishers: usize, period: Period) -> Result<(), Failure> {
    let context = jetstream::new(async_nats::connect(url).await?);
    let subjects = vec!["bare".to_owned()];
    let config = stream::Config { name: "bare".to_owned(), subjects, ..stream::Config::default() };
    context.get_or_create_stream(config).await?;
    let outcome = RefCell::new(Outcome::new(period)?);
    let end = outcome.borrow().end();
    let publisher = async || -> Result<(), Failure> {
        while Instant::now() < end {
            let sent = Instant::now();
            context.publish("bare", PAYLOAD.into()).await?.await?;
            outcome.borrow_mut().record(sent, Instant::now(), 1)?;
        }
        Ok(())
    };
    futures_util::future::try_join_all((0..publishers).map(|_| publisher())).await?;
    let mut outcome = outcome.into_inner();
    outcome.ended();
    outcome.report();
    Ok(())
}
