// Which splats touch which tiles of an image: for every tile its splats, front to back.
//
// A splat is drawn where sigma = p (dx - m dy)^2 + q dy^2 is at most log(opacity / alpha_min), an
// ellipse: on one pixel row an interval, over the rows of a tile a union of intervals. The lists
// are exact and as long as need be; they do not depend on the number of threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "parallel.h"

namespace pgjax::raster {

using Index = std::int64_t;
constexpr int kTile = 8;   // width of a tile in pixels
constexpr int kShape = 6;  // numbers that describe a splat: u, v, m, p, q, opacity

template <class T>
struct Rule {
  T alpha_max, alpha_min, stop;
  bool smooth;
};

// One image: what is drawn. Arrays are (n, 6), (n, channels) and (n).
template <class T>
struct Splats {
  Index count, channels;
  const T* shape;
  const T* values;
  const T* key;
};

struct Frame {
  int width, height;
  int columns() const { return (width + kTile - 1) / kTile; }
  int rows() const { return (height + kTile - 1) / kTile; }
  Index tiles() const { return Index(columns()) * rows(); }
};

struct Entry {
  std::uint32_t rank;  // of the splat, front to back
  std::uint32_t pair;  // number of the pair (splat, tile), all those of a splat side by side
};

// A run of tiles in one row of tiles that one splat touches.
struct Span {
  std::uint32_t rank;
  std::int32_t row, first, last;
};

inline int clamped(double x, int low, int high) {
  return x >= high ? high : x >= low ? int(x) : low;
}
// First tile with a pixel centre at or above `low`, last with one at or below `high`.
inline int first_tile(double low, int count) {
  return clamped(std::ceil((low + 0.5) / kTile - 1), 0, count);
}
inline int last_tile(double high, int count) {
  return clamped(std::floor((high - 0.5) / kTile), -1, count - 1);
}

// The ellipse of a splat, slightly larger than exact: rounding moves sigma by far less.
struct Ellipse {
  double u, v, m, p, q, reach, half_width, half_height;

  template <class T>
  Ellipse(const T* shape, double log_ratio)
      : u(shape[0]), v(shape[1]), m(shape[2]), p(shape[3]), q(shape[4]),
        reach(log_ratio * (1 + 1e-3) + 1e-3), half_width(std::sqrt(reach * (1 / p + m * m / q))),
        half_height(std::sqrt(reach / q)) {}

  bool meets(const Frame& frame) const {
    return u + half_width > 0 && u - half_width < frame.width && v + half_height > 0 &&
           v - half_height < frame.height;
  }
  // Calls `take(row, first, last)` for each row of tiles in which it touches any.
  template <class F>
  void spans(const Frame& frame, const F& take) const {
    constexpr double kMargin = 0.01;
    const int columns = frame.columns(), rows = frame.rows();
    const int top = first_tile(v - half_height - kMargin, rows);
    const int bottom = last_tile(v + half_height + kMargin, rows);
    // The rightmost point of the ellipse lies at dy = turn, the leftmost at -turn.
    const double turn = m / q * reach / half_width;
    for (int row = top; row <= bottom; ++row) {
      const double from = row * kTile + 0.5 - v;
      const double low = std::clamp(from, -half_height, half_height);
      const double high = std::clamp(from + (kTile - 1), -half_height, half_height);
      const auto edge = [&](double sign) {
        const double dy = std::clamp(sign * turn, low, high);
        const double width = std::sqrt(std::max(reach - q * dy * dy, 0.0) / p);
        return u + m * dy + sign * (width + kMargin);
      };
      const int first = first_tile(edge(-1), columns), last = last_tile(edge(1), columns);
      if (first <= last) take(row, first, last);
    }
  }
};

// Unsigned integers in the order of the numbers.
inline std::uint32_t ordered(float x) {
  std::uint32_t bits;
  x += 0;  // no negative zero
  std::memcpy(&bits, &x, sizeof x);
  return bits >> 31 ? ~bits : bits | 1u << 31;
}
inline std::uint64_t ordered(double x) {
  std::uint64_t bits;
  x += 0;
  std::memcpy(&bits, &x, sizeof x);
  return bits >> 63 ? ~bits : bits | std::uint64_t(1) << 63;
}

template <class Key>
struct Keyed {
  Key key;
  std::uint32_t index;
};

// A stable radix sort: equal keys stay in their order.
template <class Key>
void sort(std::vector<Keyed<Key>>& items) {
  constexpr int kDigit = 11, kBuckets = 1 << kDigit;
  std::vector<Keyed<Key>> other(items.size());
  for (int shift = 0; shift < int(8 * sizeof(Key)); shift += kDigit) {
    std::size_t begin[kBuckets] = {}, total = 0;
    const auto digit = [&](const Keyed<Key>& item) { return item.key >> shift & (kBuckets - 1); };
    for (const auto& item : items) ++begin[digit(item)];
    for (auto& b : begin) total += b, b = total - b;
    for (const auto& item : items) other[begin[digit(item)]++] = item;
    items.swap(other);
  }
}

// Visible splats front to back, and the list of each tile.
template <class T>
struct Lists {
  using Key = decltype(ordered(T{}));
  Frame frame;
  Index channels = 0, pairs = 0;
  std::vector<Keyed<Key>> order;    // by rank: the index of the splat
  std::vector<T> rows;              // by rank: the shape, then the values
  std::vector<Index> first_pair;    // by rank, and the total
  std::vector<Index> begin;         // by tile, and the total
  std::vector<Entry> entries;

  Index stride() const { return kShape + channels; }
  Index count() const { return Index(order.size()); }
  const T* row(Index rank) const { return rows.data() + rank * stride(); }

  Lists(const Splats<T>& splats, const Frame& frame, const Rule<T>& rule, Pool& pool)
      : frame(frame), channels(splats.channels) {
    find_visible(splats, rule, pool);
    sort(order);
    list(splats, rule, pool);
  }

 private:
  static constexpr Index kPart = 4096;  // splats treated by one task

  static double reach(const T* shape, const Rule<T>& rule) {
    return std::log(std::max(double(shape[5]) / double(rule.alpha_min), 1.0));
  }
  // What is not a number is never drawn: it fails every comparison.
  static bool is_sound(const T* s, T key) {
    const bool finite = std::isfinite(s[0]) && std::isfinite(s[1]) && std::isfinite(s[2]) &&
                        std::isfinite(s[3]) && std::isfinite(s[4]) && std::isfinite(s[5]);
    return finite && s[3] > 0 && s[4] > 0 && key == key;
  }

  void find_visible(const Splats<T>& splats, const Rule<T>& rule, Pool& pool) {
    const Index parts = (splats.count + kPart - 1) / kPart;
    std::vector<std::vector<Keyed<Key>>> found(parts);
    pool.run(parts, [&](Index part) {
      const Index end = std::min(splats.count, (part + 1) * kPart);
      for (Index i = part * kPart; i < end; ++i) {
        const T* shape = splats.shape + i * kShape;
        if (!(shape[5] >= rule.alpha_min) || !is_sound(shape, splats.key[i])) continue;
        if (!Ellipse(shape, reach(shape, rule)).meets(frame)) continue;
        found[part].push_back({ordered(splats.key[i]), std::uint32_t(i)});
      }
    });
    for (const auto& part : found) order.insert(order.end(), part.begin(), part.end());
  }

  struct Part {
    std::vector<Span> spans;
    std::vector<std::uint32_t> here;  // pairs per tile, then where the next one goes
    Index pairs = 0;
  };

  void list(const Splats<T>& splats, const Rule<T>& rule, Pool& pool) {
    const Index tiles = frame.tiles(), each = std::max(kPart, count() / 16 + 1);
    std::vector<Part> parts((count() + each - 1) / each);
    rows.resize(count() * stride());
    first_pair.assign(count() + 1, 0);
    pool.run(Index(parts.size()), [&](Index part) {
      parts[part].here.assign(tiles, 0);
      parts[part].spans.reserve(4 * each);
      const Index end = std::min(count(), (part + 1) * each);
      for (Index rank = part * each; rank < end; ++rank) enter(splats, rule, rank, parts[part]);
    });
    for (const auto& part : parts) pairs += part.pairs;
    if (pairs > Index(UINT32_MAX)) throw std::length_error("an image needs more than 2^32 pairs");
    begin.assign(tiles + 1, 0);
    Index total = 0;
    for (Index tile = 0; tile < tiles; ++tile) {
      begin[tile] = total;
      for (auto& part : parts) {
        const Index here = part.here[tile];
        part.here[tile] = std::uint32_t(total);
        total += here;
      }
    }
    begin[tiles] = total;
    for (Index rank = 0; rank < count(); ++rank) first_pair[rank + 1] += first_pair[rank];
    entries.resize(pairs);
    pool.run(Index(parts.size()), [&](Index part) {
      const Index start = part * each;
      Index pair = start < count() ? first_pair[start] : 0;
      for (const Span& span : parts[part].spans)
        for (int column = span.first; column <= span.last; ++column) {
          const Index tile = Index(span.row) * frame.columns() + column;
          entries[parts[part].here[tile]++] = {span.rank, std::uint32_t(pair++)};
        }
    });
  }

  void enter(const Splats<T>& splats, const Rule<T>& rule, Index rank, Part& part) {
    const Index i = order[rank].index;
    const T* shape = splats.shape + i * kShape;
    T* row = rows.data() + rank * stride();
    std::copy_n(shape, kShape, row);
    std::copy_n(splats.values + i * channels, channels, row + kShape);
    Index own = 0;
    Ellipse(shape, reach(shape, rule)).spans(frame, [&](int tiles, int first, int last) {
      part.spans.push_back({std::uint32_t(rank), tiles, first, last});
      for (int column = first; column <= last; ++column)
        ++part.here[Index(tiles) * frame.columns() + column];
      own += last - first + 1;
    });
    first_pair[rank + 1] = own;
    part.pairs += own;
  }
};

}  // namespace pgjax::raster
