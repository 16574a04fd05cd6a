//! [`Types`]: the layouts and definitions of message types, by name.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard};

use sgc_cdr::{Layout, Library, TypeError, TypeName};
use sgc_sync::lock;

use crate::error::GatewayError;
use crate::offload::offload;

/// Most cached types. Beyond that the cache is emptied.
const TYPES_MAX: usize = 4096;

/// A source of definitions beyond those that ship with SGC. Calls may read files and block.
pub trait FindDefinitions: Send + Sync + 'static {
    /// Returns the text of the file that defines this type.
    fn text(&self, file: &TypeName) -> Option<String>;

    /// Returns the type as another node described it, if it has this hash.
    fn described(&self, name: &TypeName, hash: Option<&str>) -> Option<Arc<Layout>>;
}

impl<F: FindDefinitions + ?Sized> FindDefinitions for Arc<F> {
    fn text(&self, file: &TypeName) -> Option<String> {
        (**self).text(file)
    }

    fn described(&self, name: &TypeName, hash: Option<&str>) -> Option<Arc<Layout>> {
        (**self).described(name, hash)
    }
}

/// A source without further definitions.
#[derive(Clone, Copy, Debug, Default)]
pub struct ShippedDefinitions;

impl FindDefinitions for ShippedDefinitions {
    fn text(&self, _file: &TypeName) -> Option<String> {
        None
    }

    fn described(&self, _name: &TypeName, _hash: Option<&str>) -> Option<Arc<Layout>> {
        None
    }
}

/// The kind of interface that a type belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InterfaceType {
    /// A topic.
    Message,
    /// A service.
    Service,
    /// An action.
    Action,
}

impl InterfaceType {
    fn words(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Message => ("msg", "topic", "std_msgs/msg/String"),
            Self::Service => ("srv", "service", "std_srvs/srv/SetBool"),
            Self::Action => ("action", "action", "example_interfaces/action/Fibonacci"),
        }
    }

    /// Returns the full name of a type. `std_msgs/String`, the form of ROS 1 that programs still use, becomes
    /// `std_msgs/msg/String`.
    pub fn full_name(self, name: &str) -> Result<String, GatewayError> {
        let (kind, what, example) = self.words();
        let full = match name.split('/').collect::<Vec<_>>()[..] {
            [package, short] => format!("{package}/{kind}/{short}"),
            _ => name.to_owned(),
        };
        // An action's services and messages have types of kind `action`.
        let fits = |name: &TypeName| name.kind() == kind || name.kind() == "action";
        match full.parse::<TypeName>() {
            Ok(parsed) if fits(&parsed) => Ok(full),
            _ => Err(GatewayError::TypeName { name: name.to_owned(), what, example }),
        }
    }
}

/// Layouts by type name and requested hash.
type LayoutCache = BTreeMap<(String, Option<String>), Arc<Layout>>;

/// The layouts and definitions of message types.
pub struct Types {
    finder: Box<dyn FindDefinitions>,
    known: Mutex<LayoutCache>,
}

impl fmt::Debug for Types {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Types").finish_non_exhaustive()
    }
}

impl Types {
    /// Creates types that ask `finder` first and then use the definitions that ship.
    pub fn new(finder: impl FindDefinitions) -> Self {
        Self { finder: Box::new(finder), known: Mutex::default() }
    }

    /// Returns the layout of a type: from a local definition with this hash, else from another node's description.
    /// Without a hash the first one found is used. May read files.
    pub fn layout(&self, type_name: &str, hash: Option<&str>) -> Result<Arc<Layout>, GatewayError> {
        let key = (type_name.to_owned(), hash.map(str::to_owned));
        if let Some(known) = self.lock().get(&key) {
            return Ok(Arc::clone(known));
        }
        let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
            name: type_name.to_owned(),
            what: "message",
            example: "std_msgs/msg/String",
        })?;
        let find = || Library::empty().layout(&name, &mut |file| self.finder.text(file));
        let found = offload(find).map(Arc::new);
        let is_it = |layout: &Arc<Layout>| hash.is_none_or(|hash| layout.type_hash() == hash);
        let mut is_sure = true;
        let layout = match found {
            Ok(layout) if is_it(&layout) => layout,
            found => match (offload(|| self.finder.described(&name, hash)), found) {
                (Some(described), _) => described,
                // The hash may be computed in another way, or the description may still arrive. A wrong layout shows
                // when decoding.
                (None, Ok(layout)) => {
                    is_sure = false;
                    layout
                }
                (None, Err(error)) => return Err(GatewayError::Definition(error)),
            },
        };
        if !is_sure {
            return Ok(layout);
        }
        let mut known = self.lock();
        if known.len() >= TYPES_MAX {
            known.clear();
        }
        known.insert(key, Arc::clone(&layout));
        Ok(layout)
    }

    /// Returns the text of the file that defines a type. A service or action has all its parts in one file.
    pub fn text(&self, type_name: &str) -> Result<String, GatewayError> {
        let unknown = |name: TypeName| GatewayError::Definition(TypeError::Unknown { name, needed_by: None });
        let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
            name: type_name.to_owned(),
            what: "message",
            example: "std_msgs/msg/String",
        })?;
        let file = TypeName::new(name.package(), name.kind(), name.file_stem());
        let file = file.ok_or_else(|| unknown(name.clone()))?;
        offload(|| self.finder.text(&file)).or_else(|| Library::shipped(&file)).ok_or_else(|| unknown(name))
    }

    /// Returns the file that defines an interface and the files that its parts need. May read them.
    pub(crate) fn files_of(&self, file: &TypeName) -> BTreeSet<TypeName> {
        let parts: &[&str] = match file.kind() {
            "srv" => &["_Request", "_Response"],
            "action" => &["_Goal", "_Result", "_Feedback"],
            _ => &[""],
        };
        let mut files = BTreeSet::from([file.clone()]);
        let mut library = Library::empty();
        for part in parts {
            let Ok(part) = format!("{file}{part}").parse() else { continue };
            // A type known only by its description has no files.
            let _ = library.layout(&part, &mut |needed| {
                files.insert(needed.clone());
                self.text(&needed.to_string()).ok()
            });
        }
        files
    }

    fn lock(&self) -> MutexGuard<'_, LayoutCache> {
        lock(&self.known)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_names_are_those_of_ros_1() {
        let full = |of: InterfaceType, name: &str| of.full_name(name);
        assert_eq!(full(InterfaceType::Message, "std_msgs/String").unwrap(), "std_msgs/msg/String");
        assert_eq!(full(InterfaceType::Service, "std_srvs/SetBool").unwrap(), "std_srvs/srv/SetBool");
        assert_eq!(
            full(InterfaceType::Message, "a/action/B_FeedbackMessage").unwrap(),
            "a/action/B_FeedbackMessage"
        );
        for wrong in ["String", "std_msgs/srv/String", "", "a/b/c/d", "std msgs/String"] {
            assert!(full(InterfaceType::Message, wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn found_definitions_precede_shipped_ones() {
        struct One;
        impl FindDefinitions for One {
            fn text(&self, file: &TypeName) -> Option<String> {
                (file.to_string() == "mine/msg/A").then(|| "int32 a".to_owned())
            }
            fn described(&self, _: &TypeName, _: Option<&str>) -> Option<Arc<Layout>> {
                None
            }
        }
        let types = Types::new(One);
        assert!(
            types.layout("mine/msg/A", None).is_ok() && types.layout("std_msgs/msg/String", None).is_ok()
        );
        assert!(types.layout("mine/msg/B", None).is_err());
        assert!(types.text("std_srvs/srv/SetBool_Request").unwrap().contains("---"));
    }
}
