//! Loops of a law and a plate in the z plane: poles, margins, and where they fail, predicted and measured.
