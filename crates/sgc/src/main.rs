//! The program `sgc`.

use std::process::ExitCode;

fn main() -> ExitCode {
    // The Makefile sets the variables.
    sgc::main(sgc::Build { commit: option_env!("SGC_COMMIT"), date: option_env!("SGC_COMMIT_DATE") })
}
