//! The committed code matches the definitions below `proto`. With `SGC_GENERATE=1` it is generated anew.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

const SERVICE: &str = "opentelemetry/proto/collector/metrics/v1/metrics_service.proto";
const STATUS: &str = "sgc/otlp/status.proto";
const FILES: [&str; 5] = [
    "opentelemetry.proto.collector.metrics.v1.rs",
    "opentelemetry.proto.common.v1.rs",
    "opentelemetry.proto.metrics.v1.rs",
    "opentelemetry.proto.resource.v1.rs",
    "sgc.otlp.rs",
];

#[test]
fn generated_code_matches_the_proto() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let descriptors = protox::compile([SERVICE, STATUS], [here.join("proto")]).unwrap();
    let made = tempfile::tempdir().unwrap();
    prost_build::Config::new()
        .out_dir(made.path())
        // Comments of the definitions are not code of this crate, and stay where they are.
        .disable_comments(["."])
        .compile_fds(descriptors)
        .unwrap();
    for file in FILES {
        let made = fs::read(made.path().join(file)).unwrap();
        let committed = here.join("src/generated").join(file);
        if std::env::var_os("SGC_GENERATE").is_some() {
            fs::write(committed, made).unwrap();
            continue;
        }
        let is_same = fs::read(&committed).is_ok_and(|old| old == made);
        assert!(
            is_same,
            "{file} is not what the proto says: SGC_GENERATE=1 cargo test -p sgc-otlp --test proto"
        );
    }
}
