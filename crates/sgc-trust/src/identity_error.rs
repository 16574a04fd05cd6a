//! [`IdentityError`]: the reason why a text is no identity.

use sgc_wire::DecodeError;

use crate::blocks::{ABOUT_BLOCK, CA_BLOCK, CERTIFICATE_BLOCK, KEY_BLOCK};
use crate::cert_error::CertError;
use crate::label::{LabelError, NodeName};
use crate::pem::PemError;
use crate::secret::NAMING_BLOCK;
use crate::verify::AnchorError;

/// The reason why a text is no identity.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IdentityError {
    /// The file is not a sequence of blocks.
    #[error("this is not an identity file")]
    File(#[source] PemError),
    /// A block that this version does not know.
    #[error("block \"{0}\" does not belong into an identity file")]
    UnknownBlock(String),
    /// A block occurs twice.
    #[error("block \"{0}\" occurs twice in the identity file")]
    Repeated(&'static str),
    /// A block is missing.
    #[error("block \"{0}\" is missing from the identity file")]
    Missing(&'static str),
    /// The block that names the node is broken.
    #[error("block \"{ABOUT_BLOCK}\" is broken")]
    About(#[source] DecodeError),
    /// An invalid name.
    #[error("block \"{ABOUT_BLOCK}\" holds an illegal name")]
    Name(#[source] LabelError),
    /// A CA certificate is broken.
    #[error("block \"{CA_BLOCK}\" is broken")]
    Ca(#[source] AnchorError),
    /// The chain is broken or not from the CA in the same file.
    #[error("block \"{CERTIFICATE_BLOCK}\" is broken or not from the CA in this file")]
    Chain(#[source] CertError),
    /// The private key is broken or of a kind that is not supported.
    #[error("block \"{KEY_BLOCK}\" is no private key of a supported kind in PKCS #8")]
    Key,
    /// The key does not belong to the certificate.
    #[error("the private key and the certificate in the identity file do not belong together")]
    KeyMismatch,
    /// A secret has a wrong length.
    #[error("block \"{0}\" does not hold 32 bytes")]
    SecretLength(&'static str),
    /// A naming secret is broken.
    #[error("block \"{NAMING_BLOCK}\" does not hold a number of at least 2 and 32 bytes")]
    NamingSecret,
    /// The generations of secrets do not fit together.
    #[error(
        "the naming secrets do not fit: a member has one to eight generations, each once; a router has none"
    )]
    Generations,
    /// Secrets that are older than those in use.
    #[error("the naming secrets are older than those in use: they were rotated meanwhile")]
    OldSecrets,
    /// A certificate of an earlier incarnation of the node.
    #[error(
        "the certificate is of an earlier incarnation of the node than the one in use: the fleet's file that made it is \
         an old copy, `sgc fleet merge` brings it up to date"
    )]
    OldIncarnation,
    /// A private key in a file that must not have one.
    #[error("this is an identity with its private key, not an answer to a request for one")]
    HasKey,
    /// The certificate lets the node route, which was not requested.
    #[error(
        "the certificate lets the node route for others (URI sgc:role:router), which was not asked for: `--may-route` if \
         it is meant, or else have the CA sign the request again with reviewed extensions (`sgc fleet extensions`)"
    )]
    UnaskedRole,
    /// The certificate is of a later incarnation of its node: a revocation of the node would pass over it.
    #[error(
        "the certificate is of a later incarnation of the node (URI sgc:incarnation:…), which was not asked for: have the \
         CA sign the request again with reviewed extensions (`sgc fleet extensions`)"
    )]
    UnaskedIncarnation,
    /// The certificate does not let the node route.
    #[error("the certificate does not let the node route for others: it lacks the URI sgc:role:router")]
    MissingRole,
    /// The certificate's groups differ from the requested ones.
    #[error(
        "the certificate's groups are not those of `--group`: it has {unasked} that were not asked for, and lacks \
         {missing}; name them all, or have the CA sign the request again with reviewed extensions (`sgc fleet \
         extensions`)"
    )]
    OtherGroups {
        /// Number of groups of the certificate that were not requested.
        unasked: usize,
        /// Number of groups that the certificate lacks.
        missing: usize,
    },
    /// The certificate is for a node of another name, or the secret is another fleet's.
    #[error("the certificate is not that of node \"{node}\" under the fleet secret in this file")]
    NameMismatch {
        /// The name in the file.
        node: NodeName,
    },
}
