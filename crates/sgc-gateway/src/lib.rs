//! Programs without ROS on a ROS 2 network.

mod access;

pub use access::{
    ACCESS_LABEL_BYTES_MAX, ACCESS_TOKEN_PREFIX, ACCESS_TOKEN_TEXT_BYTES_MAX, ACCESS_VALID_MS_MAX, Access,
    AccessGrant, AccessRules, AccessToken, AccessTokenError, Admission, AdmittedBy, Anonymous, Client,
    ClientRule, Denied, ORIGIN_BYTES_MAX, PageOrigin, PageOriginError, Right, SCOPE_BYTES_MAX,
    SCOPE_PATTERNS_MAX, Scope, ScopeError, TokenId, TokenIdError, check_access_label,
};
