//! Locks that stay usable after a panic of their holder, [threads that queues share](Workers), and a [limit on
//! borrowed time](Pace) of threads that receive.
//!
//! Release builds abort on panic, so poison is seen in tests only. There the panic itself fails the test, and a second
//! panic in another thread would hide it.

mod pace;
mod workers;

pub use pace::Pace;
pub use workers::{Work, Workers};

use std::sync::{Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Locks a mutex, and waits until that is possible.
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Locks for reading, and waits until no writer has the lock.
pub fn read_lock<T: ?Sized>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

/// Locks for writing, and waits until nobody else has the lock.
pub fn write_lock<T: ?Sized>(lock: &RwLock<T>) -> RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locks_stay_usable_after_a_panic_of_their_holder() {
        let (mutex, shared) = (Mutex::new(1), RwLock::new(2));
        let held = std::thread::scope(|scope| {
            let thread = scope.spawn(|| {
                let _held = (lock(&mutex), write_lock(&shared));
                panic!("on purpose");
            });
            thread.join()
        });
        assert!(held.is_err() && mutex.is_poisoned() && shared.is_poisoned());
        *lock(&mutex) += 1;
        *write_lock(&shared) += 1;
        assert_eq!((*lock(&mutex), *read_lock(&shared)), (2, 3));
    }
}
