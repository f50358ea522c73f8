// One function of one particle, run for many: the arrays of particles are turned over in blocks,
// so that each number becomes a vector of the same number of a whole group of particles.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "parallel.h"

namespace pgjax {

constexpr int kVectorBytes = 64;

template <class T>
struct GroupOf {
  typedef T type __attribute__((vector_size(kVectorBytes)));
};
template <class T>
using Group = typename GroupOf<T>::type;
template <class T>
constexpr int kGroup = kVectorBytes / sizeof(T);  // particles in a group

// `size` numbers per particle, those of one particle side by side.
template <class T>
struct Column {
  T* data;
  int size;
};

constexpr int kBlock = 128;  // particles turned over at a time

// Calls `one(in, out)` with vectors of the entries of all `ins` and `outs`, one after the other.
template <class T, int NumberIn, int NumberOut, int Ins, int Outs, class F>
void for_each_block(std::int64_t count, const Column<const T> (&ins)[Ins],
                    const Column<T> (&outs)[Outs], Pool& pool, const F& one) {
  using V = Group<T>;
  pool.run((count + kBlock - 1) / kBlock, [&](std::int64_t block) {
    const std::int64_t first = block * kBlock;
    const int size = int(std::min<std::int64_t>(kBlock, count - first));
    // The rest of the last group holds zeros, for which every function is defined.
    alignas(kVectorBytes) T in[NumberIn][kBlock] = {};
    alignas(kVectorBytes) T out[NumberOut][kBlock];
    int row = 0;
    for (const auto& column : ins)
      for (int e = 0; e < column.size; ++e, ++row)
        for (int p = 0; p < size; ++p) in[row][p] = column.data[(first + p) * column.size + e];
    for (int p = 0; p < size; p += kGroup<T>) {
      V given[NumberIn], made[NumberOut];
      for (int e = 0; e < NumberIn; ++e) given[e] = *reinterpret_cast<const V*>(&in[e][p]);
      one(given, made);
      for (int e = 0; e < NumberOut; ++e) *reinterpret_cast<V*>(&out[e][p]) = made[e];
    }
    row = 0;
    for (const auto& column : outs)
      for (int e = 0; e < column.size; ++e, ++row)
        for (int p = 0; p < size; ++p) column.data[(first + p) * column.size + e] = out[row][p];
  });
}

template <class V>
inline V root(V x) {
  V r;
  // One instruction: the compiler is told that errno is not looked at.
  for (unsigned l = 0; l < sizeof(V) / sizeof(x[0]); ++l) r[l] = std::sqrt(x[l]);
  return r;
}
template <class V>
inline V at_least(V x, V low) {
  return x > low ? x : low;
}

}  // namespace pgjax
