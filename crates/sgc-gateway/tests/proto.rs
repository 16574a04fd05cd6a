//! The committed code and descriptors match `gateway.proto`. With `SGC_GENERATE=1` they are generated anew.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

const PROTO: &str = "sgc/gateway/v1/gateway.proto";
/// The generated files and their places. The Python client uses the descriptor as it is.
const FILES: [(&str, &str); 3] = [
    ("sgc.gateway.v1.rs", "src/grpc/generated/sgc.gateway.v1.rs"),
    (DESCRIPTOR, "src/grpc/generated/descriptor.bin"),
    (DESCRIPTOR, "../../clients/python/src/sgc/gateway.binpb"),
];
const DESCRIPTOR: &str = "descriptor.bin";

#[test]
fn generated_code_matches_the_proto() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut compiler = protox::Compiler::new([here.join("proto")]).unwrap();
    compiler.include_source_info(true).include_imports(true).open_file(PROTO).unwrap();
    let made = tempfile::tempdir().unwrap();
    tonic_prost_build::configure()
        .out_dir(made.path())
        .bytes(".")
        .emit_rerun_if_changed(false)
        .compile_fds(compiler.file_descriptor_set())
        .unwrap();
    // Reflection has no use for comments, which are three quarters of the descriptor.
    compiler.include_source_info(false);
    fs::write(made.path().join(DESCRIPTOR), compiler.encode_file_descriptor_set()).unwrap();

    for (file, committed) in FILES {
        let (made, committed) = (fs::read(made.path().join(file)).unwrap(), here.join(committed));
        if std::env::var_os("SGC_GENERATE").is_some() {
            fs::write(committed, made).unwrap();
            continue;
        }
        let is_same = fs::read(&committed).is_ok_and(|old| old == made);
        assert!(
            is_same,
            "{file} is not what the proto says: SGC_GENERATE=1 cargo test -p sgc-gateway --test proto"
        );
    }
}
