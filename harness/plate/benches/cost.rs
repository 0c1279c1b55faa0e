//! What a step of each tier costs: `cargo bench -p platebench-plate --bench cost`. Times; what a
//! build is held to are the instruction counts of `counts.rs`.

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
