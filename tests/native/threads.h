// What the checks share: threads like those of XLA, and arrays with a batch direction.
#pragma once

#include <condition_variable>
#include <thread>
#include <vector>

#include "transfer.h"

using namespace pgjax;

namespace {

// Threads that take tasks from a list, like those of XLA.
class Threads {
 public:
  explicit Threads(int n) {
    for (int i = 0; i < n; ++i) threads_.emplace_back([this] { serve(); });
  }
  ~Threads() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      closed_ = true;
    }
    changed_.notify_all();
    for (auto& t : threads_) t.join();
  }
  Pool pool() {
    return Pool(std::int64_t(threads_.size()) + 1, [this](std::function<void()> task) {
      {
        std::lock_guard<std::mutex> lock(mutex_);
        tasks_.push_back(std::move(task));
      }
      changed_.notify_one();
    });
  }

 private:
  void serve() {
    for (;;) {
      std::function<void()> task;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        changed_.wait(lock, [this] { return closed_ || !tasks_.empty(); });
        if (tasks_.empty()) return;
        task = std::move(tasks_.back());
        tasks_.pop_back();
      }
      task();
    }
  }
  std::mutex mutex_;
  std::condition_variable changed_;
  bool closed_ = false;
  std::vector<std::function<void()>> tasks_;
  std::vector<std::thread> threads_;
};

template <class T>
using Numbers = std::vector<T>;

template <class T>
Batched<const T> in(const Numbers<T>& a, Index batch) {
  return {a.data(), batch > 1 ? Index(a.size()) / batch : 0};
}
template <class T>
Batched<T> out(Numbers<T>& a, Index batch) {
  return {a.data(), Index(a.size()) / batch};
}

}  // namespace
