//! `cargo bench -p sgc-bench-instructions`: everything is in the library, which has tests.

use std::process::ExitCode;

fn main() -> ExitCode {
    sgc_bench_instructions::main()
}
