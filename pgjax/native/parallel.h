// Work shared by the calling thread and those of a pool.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>

namespace pgjax {

// Runs numbered tasks. The caller takes part, and waits only for tasks that another thread has
// begun: a pool that is busy elsewhere delays nothing and cannot deadlock.
class Pool {
 public:
  using Schedule = std::function<void(std::function<void()>)>;

  Pool() = default;
  Pool(std::int64_t threads, Schedule schedule) : threads_(threads), schedule_(schedule) {}

  std::int64_t threads() const { return threads_; }

  // Calls `task(i)` for i = 0 ... count - 1, in any order, and returns when all are done.
  template <class F>
  void run(std::int64_t count, const F& task) {
    const std::int64_t helpers = std::min(threads_, count) - 1;
    if (helpers < 1) {
      for (std::int64_t i = 0; i < count; ++i) task(i);
      return;
    }
    // Owned by everyone who may still look at it: a helper may start after the work is done.
    auto shared = std::make_shared<Shared>();
    shared->count = count;
    shared->call = [&task](std::int64_t i) { task(i); };
    for (std::int64_t k = 0; k < helpers; ++k) schedule_([shared] { shared->work(); });
    shared->work();
    shared->wait();
  }

 private:
  struct Shared {
    std::int64_t count = 0;
    std::function<void(std::int64_t)> call;
    std::atomic<std::int64_t> next{0}, done{0};
    std::mutex mutex;
    std::condition_variable finished;

    void work() {
      std::int64_t mine = 0;
      for (std::int64_t i; (i = next.fetch_add(1)) < count; ++mine) call(i);
      if (mine && done.fetch_add(mine) + mine == count) {
        std::lock_guard<std::mutex> lock(mutex);
        finished.notify_all();
      }
    }
    void wait() {
      // Tasks are short: look for a while before sleeping.
      for (int spin = 0; spin < 20000; ++spin)
        if (done.load() == count) return;
      std::unique_lock<std::mutex> lock(mutex);
      finished.wait(lock, [this] { return done.load() == count; });
    }
  };

  std::int64_t threads_ = 1;
  Schedule schedule_;
};

}  // namespace pgjax
