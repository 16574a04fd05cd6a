//! The program `sgc`.

use std::process::ExitCode;

fn main() -> ExitCode {
    sgc::main()
}
