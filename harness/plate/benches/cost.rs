//! Measures the time of a step of each model: `cargo bench -p platebench-plate --bench cost`.

mod steps;

use divan::Bencher;
use divan::counter::ItemsCount;
use steps::{STEPS, Step};

fn main() {
    divan::main();
}

#[divan::bench(args = STEPS, sample_count = 200)]
fn step(bencher: Bencher<'_, '_>, step: &Step) {
    let run = step.prepare();
    bencher.counter(ItemsCount::new(step.items)).bench_local(run);
}
