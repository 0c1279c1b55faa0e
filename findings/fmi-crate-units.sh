#!/usr/bin/env bash
# Rust crate fmi-schema 0.8.0, which fmi 0.8.0 reads FMUs with: refuses an FMI 3 unit with ampere or kelvin.
#
# The attributes of `BaseUnit` in FMI 3.0 are kg, m, s, A, K, mol, cd and rad. The crate names two of them `a` and `k`
# and refuses unknown ones, so no FMU that defines kelvin, °C, ampere or volt can be read. The wrong letter is
# accepted. The units of FMI 2 are right.
#
# Output seen:
#   m="1": read
#   K="1": XmlParse(UnknownField { name: "BaseUnit", field: "K" })
#   A="1": XmlParse(UnknownField { name: "BaseUnit", field: "A" })
#   k="1": read
#
# What to do: delete `UnitDefinitions` from a copy of the FMU for this crate, or use another reader.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkdir "$folder/src"
cd "$folder"
cat >Cargo.toml <<'TOML'
[package]
name = "units"
version = "0.1.0"
edition = "2021"
[dependencies]
fmi-schema = { version = "=0.8.0", default-features = false, features = ["fmi3"] }
TOML
cat >src/main.rs <<'RUST'
use fmi_schema::{fmi3::Fmi3ModelDescription, traits::FmiModelDescription};

fn main() {
    for unit in ["m", "K", "A", "k"] {
        let description = format!(
            r#"<fmiModelDescription fmiVersion="3.0" modelName="plate" instantiationToken="1">
<CoSimulation modelIdentifier="plate"/>
<UnitDefinitions><Unit name="unit"><BaseUnit {unit}="1"/></Unit></UnitDefinitions>
<ModelVariables>
<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
</ModelVariables>
<ModelStructure/></fmiModelDescription>"#
        );
        match Fmi3ModelDescription::deserialize(&description) {
            Ok(_) => println!("{unit}=\"1\": read"),
            Err(error) => println!("{unit}=\"1\": {error:?}"),
        }
    }
}
RUST
cargo run --quiet --jobs 1 >output
cat output
diff output - <<'EXPECTED'
m="1": read
K="1": XmlParse(UnknownField { name: "BaseUnit", field: "K" })
A="1": XmlParse(UnknownField { name: "BaseUnit", field: "A" })
k="1": read
EXPECTED
