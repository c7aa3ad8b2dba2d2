//! Compares writes to a log with a bare publisher that awaits the same acknowledgements.
//!
//! Arguments: the URL of a nats-server with JetStream, and the number of rounds. In each round, both are
//! measured one after the other, so that changes of the machine's speed affect both.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use async_nats::jetstream;
use holdfast_journal::log::{Log, Settings};
use holdfast_memory::{Access, Area, Layout, Memory, Operation, Span, Write};

const WRITERS: usize = 64;
const ROUND: Duration = Duration::from_secs(2);
/// Pauses between the writes whose latency is measured.
const PAUSE: Duration = Duration::from_millis(1);

fn main() {
    let mut arguments = std::env::args().skip(1);
    let url = arguments.next().expect("the URL of a server");
    let rounds: usize = arguments.next().map_or(5, |text| text.parse().expect("rounds"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let bare = runtime.block_on(async {
        let context = jetstream::new(async_nats::connect(&url).await.unwrap());
        let config = jetstream::stream::Config {
            name: "bare".to_owned(),
            subjects: vec!["bare".to_owned()],
            ..jetstream::stream::Config::default()
        };
        context.create_stream(config).await.unwrap();
        context
    });
    let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 1000).unwrap());
    let memory = Arc::new(Memory::new(layout, None).unwrap());
    let settings = Settings::new("speed", "a", vec![url]);
    let log = Log::new(settings, vec![("plant".to_owned(), Arc::clone(&memory))]).unwrap();
    log.start().unwrap();
    assert!(log.wait_until_caught_up(Duration::from_secs(30)).unwrap());

    let (mut rates, mut latencies) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        let of_bare = runtime.block_on(bare_rate(&bare));
        let before = log.status().last_sequence;
        let of_log = log_rate(&memory);
        let messages = (log.status().last_sequence - before) as f64 / ROUND.as_secs_f64();
        println!("writes/s: log {of_log:.0} in {messages:.0} messages/s, bare {of_bare:.0}");
        rates.push(of_log / of_bare);
        let of_bare = runtime.block_on(bare_latency(&bare));
        let of_log = log_latency(&memory);
        println!("p50: log {of_log:?}, bare {of_bare:?}");
        latencies.push(of_log.as_secs_f64() / of_bare.as_secs_f64());
    }
    println!("writes/s, log to bare: {:.2}", median(rates));
    println!("p50, log to bare: {:.2}", median(latencies));
    log.stop();
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// As large as the message of a write of one register.
const PAYLOAD: &[u8] = &[0; 45];

async fn bare_rate(context: &jetstream::Context) -> f64 {
    let count = AtomicU64::new(0);
    let end = Instant::now() + ROUND;
    let writers = (0..WRITERS).map(|_| async {
        while Instant::now() < end {
            context.publish("bare", PAYLOAD.into()).await.unwrap().await.unwrap();
            count.fetch_add(1, Ordering::Relaxed);
        }
    });
    futures_util::future::join_all(writers).await;
    count.into_inner() as f64 / ROUND.as_secs_f64()
}

/// Each writer gives its next write away when the last one is confirmed.
fn log_rate(memory: &Arc<Memory>) -> f64 {
    let count = Arc::new(AtomicU64::new(0));
    let stop = Arc::new(AtomicBool::new(false));
    let running = Arc::new(AtomicU64::new(WRITERS as u64));
    for writer in 0..WRITERS {
        next(memory, writer as u16, &count, &stop, &running);
    }
    std::thread::sleep(ROUND);
    stop.store(true, Ordering::Relaxed);
    let counted = count.load(Ordering::Relaxed);
    while running.load(Ordering::Relaxed) > 0 {
        std::thread::sleep(Duration::from_millis(1));
    }
    counted as f64 / ROUND.as_secs_f64()
}

fn next(
    memory: &Arc<Memory>,
    address: u16,
    count: &Arc<AtomicU64>,
    stop: &Arc<AtomicBool>,
    running: &Arc<AtomicU64>,
) {
    let write = Write { area: Area::HoldingRegisters, address, count: 1, bytes: &[1, 2] };
    let (again, count) = (Arc::clone(memory), Arc::clone(count));
    let (stop, running) = (Arc::clone(stop), Arc::clone(running));
    let done = Box::new(move |outcome: holdfast_memory::Outcome| {
        outcome.unwrap();
        count.fetch_add(1, Ordering::Relaxed);
        if stop.load(Ordering::Relaxed) {
            running.fetch_sub(1, Ordering::Relaxed);
        } else {
            next(&again, address, &count, &stop, &running);
        }
    });
    memory.submit(Access::Client, Operation::Write(&[write]), done).unwrap();
}

async fn bare_latency(context: &jetstream::Context) -> Duration {
    let end = Instant::now() + ROUND;
    let mut took = Vec::new();
    while Instant::now() < end {
        let began = Instant::now();
        context.publish("bare", PAYLOAD.into()).await.unwrap().await.unwrap();
        took.push(began.elapsed());
        tokio::time::sleep(PAUSE).await;
    }
    took.sort();
    took[took.len() / 2]
}

fn log_latency(memory: &Memory) -> Duration {
    let end = Instant::now() + ROUND;
    let mut took = Vec::new();
    let write = Write { area: Area::HoldingRegisters, address: 0, count: 1, bytes: &[1, 2] };
    while Instant::now() < end {
        let began = Instant::now();
        memory.write(Access::Client, write).unwrap();
        took.push(began.elapsed());
        std::thread::sleep(PAUSE);
    }
    took.sort();
    took[took.len() / 2]
}
