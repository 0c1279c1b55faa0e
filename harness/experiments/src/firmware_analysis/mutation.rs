//! Changes one machine instruction at a time and checks whether the scenarios notice.

mod candidates;
mod condition;
mod disassembler;
mod encoding;
mod measure;
mod mutant;
mod result;
mod schema;
mod text;

pub use candidates::{MutantFilter, all_mutants};
pub use disassembler::Disassembler;
pub use measure::{MutationConfig, measure_mutation};
pub use mutant::{Mutant, Operator};
pub use result::{MutantResult, MutationReport, Status};
pub use schema::mutation_json;
pub use text::summary;
