//! Code generated from the definitions below `proto`: those of OpenTelemetry, release 1.10.0, and the fields of
//! `google.rpc.Status` that matter here. `tests/proto.rs` generates it.
#![allow(missing_docs, unreachable_pub, dead_code, rustdoc::all, reason = "generated")]
#![allow(clippy::all, reason = "generated")]

// The modules have the paths of the packages, since generated code names its neighbours by them.
pub(crate) mod proto {
    pub mod collector {
        pub mod metrics {
            pub mod v1 {
                include!("generated/opentelemetry.proto.collector.metrics.v1.rs");
            }
        }
    }
    pub mod common {
        pub mod v1 {
            include!("generated/opentelemetry.proto.common.v1.rs");
        }
    }
    pub mod metrics {
        pub mod v1 {
            include!("generated/opentelemetry.proto.metrics.v1.rs");
        }
    }
    pub mod resource {
        pub mod v1 {
            include!("generated/opentelemetry.proto.resource.v1.rs");
        }
    }
}

pub(crate) mod status {
    include!("generated/sgc.otlp.rs");
}
