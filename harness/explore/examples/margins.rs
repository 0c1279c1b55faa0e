//! Lists the judged windows of clean scenes with the smallest margins, by property: the basis of the limits.
//!
//! `cargo run --release --ignore-rust-version -p platebench-explore --example margins -- LAW FROM UNTIL SEED [SHOWN]`

use platebench_explore::explore::scene_text;
use platebench_explore::{Envelope, Generator, LawProperties, Player, Property};
use platebench_rig::{CancelToken, RigSpec};
use platebench_scenario::load;
use platebench_wire::LawId;
use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;

type Tightest = BTreeMap<Property, Vec<(f64, u64, usize)>>;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let law = arguments.first().and_then(|name| LawId::from_name(name)).ok_or("expected a law")?;
    let number = |index: usize| arguments.get(index).and_then(|text| text.parse::<u64>().ok());
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/envelope.toml");
    let envelope = Envelope::load(&path).map_err(|faults| format!("{faults:?}"))?;
    let laws: Vec<LawId> = LawId::ALL.into_iter().filter(|law| LawProperties::of(*law).is_explored).collect();
    let generator = Generator { envelope: &envelope, seed: number(3).unwrap_or(1), law, laws: &laws };
    if let Some(index) = number(4) {
        print!("{}", scene_text(&envelope, &generator.tree(index)?.current(), "Shown").scenario);
        return Ok(());
    }
    let connect = || RigSpec::Hosted.connect();
    let cancel = CancelToken::never();
    let mut player = Player::new(&connect, false, &cancel);
    let folder = tempfile::tempdir()?;
    let (mut windows, mut failed) = (Tightest::new(), 0);
    for index in number(1).unwrap_or(0)..number(2).unwrap_or(1_000) {
        scene_text(&envelope, &generator.tree(index)?.current(), "Scene").write(folder.path(), "scene")?;
        let scenario = load(&folder.path().join("scene.toml"), "scene.toml").map_err(|fault| format!("{fault:?}"))?;
        let result = player.play(&scenario)?.ok_or("cancelled")?;
        failed += u32::from(!result.failures.is_empty());
        for (position, window) in result.windows.iter().enumerate() {
            windows.entry(window.property).or_default().push((window.margin.unwrap_or(1.0), index, position));
        }
    }
    println!("{law:?}: {failed} failed");
    for (property, margins) in &mut windows {
        margins.sort_by(|one, other| one.0.total_cmp(&other.0));
        let tightest: Vec<_> =
            margins.iter().take(10).map(|(margin, index, _)| format!("{margin:.3}@{index}")).collect();
        println!("{property:16}{:8}  {}", margins.len(), tightest.join(" "));
    }
    Ok(())
}
