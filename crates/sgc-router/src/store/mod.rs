//! The mapping `store`: the owners of names in an outside store that many routers share.

mod op;

pub use op::{
    BATCH_TAG_LEN, BatchTag, StoreAction, StoreEvent, StoreFailure, StoreKey, StoreOp, StoreOpId, StoreReply,
    WriteIf,
};
