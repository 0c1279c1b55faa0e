//! Prints the largest stable step of each integration method as CSV.

use platebench_plate::RawPlate;
use platebench_study::integration::stability;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("expected a plate file")?;
    let plate = toml::from_str::<RawPlate>(&std::fs::read_to_string(file)?)?.check()?;
    print!("{}", stability::to_csv(&stability::step_limits(&plate)));
    Ok(())
}
