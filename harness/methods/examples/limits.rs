//! Prints where each method's stability ends, as CSV.

use platebench_methods::stability;
use platebench_plate::file::RawPlate;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("expected a plate file")?;
    let plate = toml::from_str::<RawPlate>(&std::fs::read_to_string(file)?)?.check()?;
    print!("{}", stability::to_csv(&stability::limits(&plate)));
    Ok(())
}
