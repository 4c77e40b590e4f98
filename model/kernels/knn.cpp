// k nearest neighbours inside a patch, for one CPU thread; called and twinned as edgeconv.cpp is.

#include "kernels.h"
#include "tiles.h"
#include "vectors.h"

namespace {

constexpr float FAR = 3.4e38f;  // of padding and of the query itself: never chosen
constexpr int GROUPS = 64;  // disjoint, of a patch filled up to a multiple of them: see `select`

constexpr int MANY_DIMS = 16;  // from here on differences cost more than products

constexpr int PANEL = COLS * LANES;  // points that are read together, a coordinate after the other: (dims, PANEL)

// Squared distances of ROWS queries to all points; `panels` is the patch, (padded / PANEL, dims, PANEL).
inline void distances(const float* panels, int padded, const float* queries, int dims, float* out) {
  for (int j = 0; j < padded; j += PANEL, panels += (size_t)dims * PANEL) {
    vec sum[ROWS][COLS];
    for (int q = 0; q < ROWS; ++q)
      for (int c = 0; c < COLS; ++c) sum[q][c] = vec{};
    for (int d = 0; d < dims; ++d) {
      vec x[COLS];
      for (int c = 0; c < COLS; ++c) x[c] = load(panels + (size_t)d * PANEL + c * LANES);
      for (int q = 0; q < ROWS; ++q) {
        const vec from = splat(queries[(size_t)q * dims + d]);
        for (int c = 0; c < COLS; ++c) {
          const vec apart = x[c] - from;
          sum[q][c] += apart * apart;
        }
      }
    }
    for (int q = 0; q < ROWS; ++q)
      for (int c = 0; c < COLS; ++c) store(out + (size_t)q * padded + j + c * LANES, sum[q][c]);
  }
}

// The same by products, |q|^2 + |p|^2 - 2 q p, half as many operations. `queries` are of -2 q here, and `squares` are of
// all points, those of the queries from `first` on. Rounding may leave what is nearly nothing below it.
inline void distances_by_products(const float* panels, const float* squares, int first, int padded,
                                  const float* queries, int dims, float* out) {
  for (int j = 0; j < padded; j += PANEL, panels += (size_t)dims * PANEL) {
    vec sum[ROWS][COLS];
    for (int q = 0; q < ROWS; ++q)
      for (int c = 0; c < COLS; ++c) sum[q][c] = load(squares + j + c * LANES) + squares[first + q];
    for (int d = 0; d < dims; ++d) {
      vec x[COLS];
      for (int c = 0; c < COLS; ++c) x[c] = load(panels + (size_t)d * PANEL + c * LANES);
      for (int q = 0; q < ROWS; ++q) {
        const vec query = splat(queries[(size_t)q * dims + d]);
        for (int c = 0; c < COLS; ++c) sum[q][c] += x[c] * query;
      }
    }
    for (int q = 0; q < ROWS; ++q)
      for (int c = 0; c < COLS; ++c) store(out + (size_t)q * padded + j + c * LANES, sum[q][c]);
  }
}

// One point that is not finite shall not make all distances so.
inline void keep_numbers(std::vector<float>& mean) {
  for (float& x : mean)
    if (!(x > -FAR && x < FAR)) x = 0;
}

// What `select` needs beside its arguments: the candidates of one query, a vector longer than a patch.
struct Candidates {
  std::vector<float> distance;
  std::vector<int32_t> index, chosen;
  std::vector<uint64_t> keys;
  explicit Candidates(int padded)
      : distance(padded + LANES), index(padded + LANES), chosen(padded + LANES), keys(padded) {}
};

#if defined(__AVX2__)

// Which lanes of v are at most `limit`, as bits.
inline uint32_t within(ivec v, int32_t limit) {
#if defined(__AVX512F__)
  return _mm512_cmple_epi32_mask((__m512i)v, _mm512_set1_epi32(limit));
#else
  return 0xff & ~uint32_t(_mm256_movemask_ps((__m256)(v > ivec{} + limit)));
#endif
}

#if !defined(__AVX512F__)
// Of each choice of eight lanes the chosen ones, in order: a byte names a lane.
struct Choices {
  uint64_t lanes[256] = {};
  constexpr Choices() {
    for (int choice = 0; choice < 256; ++choice)
      for (int lane = 0, place = 0; lane < 8; ++lane)
        if (choice >> lane & 1) lanes[choice] |= uint64_t(lane) << 8 * place++;
  }
};
constexpr Choices CHOICES;
#endif

// The chosen lanes of v side by side to `to`, which has room for a whole vector.
inline void keep(ivec v, uint32_t chosen, int32_t* to) {
#if defined(__AVX512F__)
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(chosen), (__m512i)v));
#else
  const __m256i lanes = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(int64_t(CHOICES.lanes[chosen])));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), _mm256_permutevar8x32_epi32((__m256i)v, lanes));
#endif
}

// A threshold, as bits, that at least k of `vectors` vectors of floats reach and at most k + spare, where ties allow;
// `reached` do. All are >= 0, where floats order as their bits do, and at least k are at most `high`. Guessed by
// interpolation (on a surface as many neighbours come with each further step of squared distance), then halved.
struct Threshold { int32_t bits; int reached; };
inline Threshold threshold(const float* values, int vectors, int k, int spare, Threshold high) {
  Threshold low{-1, 0};
  for (int tries = 0; high.reached > k + spare && high.bits - low.bits > 1; ++tries) {
    int32_t guess = low.bits + (high.bits - low.bits) / 2;
    if (tries % 4 != 3) {
      const float from = low.bits < 0 ? 0.0f : float_of(low.bits);
      const float share = (k + 0.5f * (1 + spare) - low.reached) / float(high.reached - low.reached);
      guess = std::min(std::max(bits_of(from + (float_of(high.bits) - from) * share), low.bits + 1), high.bits - 1);
    }
    int found = 0;
    for (int n = 0; n < vectors; ++n) found += __builtin_popcount(within((ivec)load(values + n * LANES), guess));
    (found >= k ? high : low) = {guess, found};
  }
  return high;
}

// Indices of the k smallest distances (ties go to the lower index), in no particular order; of none that is a number: 0.
// The k-th smallest of 64 disjoint groups' minima bounds the k-th smallest of all, so one pass leaves few candidates.
inline void select(const float* distance, int padded, int k, Candidates& near, int32_t* out) {
  int32_t bound = bits_of(FAR) - 1;
  if (k <= GROUPS) {
    float least[GROUPS];
    vec most = {};
    for (int g = 0; g < GROUPS; g += LANES) {
      vec m = splat(FAR);
      for (int j = g; j < padded; j += GROUPS) {
        const vec d = load(distance + j);
        m = d < m ? d : m;  // m, where d is no number
      }
      m = m > 0 ? m : vec{};  // rounding may leave less than nothing, which orders the other way
      store(least + g, m);
      most = m > most ? m : most;
    }
    const Threshold all{bits_of(largest_lane(most)), GROUPS};
    bound = std::min(bound, threshold(least, GROUPS / LANES, k, 3, all).bits);
  }
  ivec index;
  for (int lane = 0; lane < LANES; ++lane) index[lane] = lane;
  int count = 0;
  for (int j = 0; j < padded; j += LANES, index += LANES) {
    const uint32_t chosen = within((ivec)load(distance + j), bound);
    keep(index, chosen, &near.index[count]);
    count += __builtin_popcount(chosen);
  }
  if (count == 0) {  // NaN, which then comes of them whatever the neighbours
    std::fill(out, out + k, 0);
    return;
  }
  for (int n = 0; n < count; ++n) {
    const float d = distance[near.index[n]];
    near.distance[n] = d > 0 ? d : 0;
  }
  if (count <= k) {  // fewer points than neighbours: in order, then the farthest again
    for (int n = 0; n < count; ++n)
      near.keys[n] = (uint64_t(bits_of(near.distance[n])) << 32) | uint32_t(near.index[n]);
    std::sort(near.keys.begin(), near.keys.begin() + count);
    for (int n = 0; n < k; ++n) out[n] = int32_t(uint32_t(near.keys[std::min(n, count - 1)]));
    return;
  }
  store(&near.distance[count], splat(FAR));
  const int vectors = (count + LANES - 1) / LANES;
  const Threshold last = threshold(near.distance.data(), vectors, k, 0, {bound, count});
  const int32_t sure = last.reached == k ? last.bits : last.bits - 1;  // else some lie exactly there, and not all fit
  int taken = 0;
  for (int n = 0; n < vectors; ++n) {
    const uint32_t chosen = within((ivec)load(&near.distance[n * LANES]), sure);
    keep(load(&near.index[n * LANES]), chosen, &near.chosen[taken]);
    taken += __builtin_popcount(chosen);
  }
  for (int n = 0; taken < k; ++n)
    if (bits_of(near.distance[n]) == last.bits) near.chosen[taken++] = near.index[n];
  std::memcpy(out, near.chosen.data(), (size_t)k * sizeof(int32_t));
}

#else

// Indices of the k smallest distances (ties go to the lower index), in no particular order; of none that is a number: 0.
// The k-th smallest of 64 disjoint groups' minima bounds the k-th smallest of all, so one pass leaves few keys.
inline void select(const float* distance, int padded, int k, Candidates& near, int32_t* out) {
  float bound = FAR;
  if (k <= GROUPS) {
    float least[GROUPS];
    for (int g = 0; g < GROUPS; g += LANES) {
      vec m = splat(FAR);  // NaN is less than nothing, and would put nth_element out of order
      for (int j = g; j < padded; j += GROUPS) {
        const vec d = load(distance + j);
        m = d < m ? d : m;
      }
      store(least + g, m);
    }
    std::nth_element(least, least + k - 1, least + GROUPS);
    bound = least[k - 1];
  }
  int count = 0;
  for (int j = 0; j < padded; ++j)
    if (distance[j] <= bound && distance[j] < FAR)
      near.keys[count++] = (uint64_t(bits_of(std::max(distance[j], 0.0f))) << 32) | uint32_t(j);
  if (count == 0) {  // NaN, which then comes of them whatever the neighbours
    std::fill(out, out + k, 0);
    return;
  }
  const auto begin = near.keys.begin();
  if (count > k) std::nth_element(begin, begin + k, begin + count);
  else std::sort(begin, begin + count);
  for (int n = 0; n < k; ++n) out[n] = int32_t(uint32_t(near.keys[std::min(n, count - 1)]));
}

#endif

#if defined(__AMX_BF16__)

// Squared distances in many dimensions by products, on tiles. A coordinate is the sum of two
// bf16, `high` and `low`, of whose products low times low is left out: 2^-16 of |q| |p|. Squares are sums of three.
class Products {
 public:
  Products(const float* points, int count, int dims, int padded)
      : steps_((dims + DEPTH - 1) / DEPTH), queries_(size_(padded)), points_(size_(padded)) {
    std::vector<float> mean((size_t)steps_ * DEPTH, 0.0f);  // squares of what all have in common would swallow the rest
    for (int i = 0; i < count; ++i)
      for (int d = 0; d < dims; ++d) mean[d] += points[(size_t)i * dims + d] / count;
    keep_numbers(mean);
    const __m512 twice = _mm512_set1_ps(-2.0f);
    for (int i = 0; i < count; ++i) {
      __m512 squares = _mm512_setzero_ps();
      for (int step = 0; step < steps_; ++step) {
        __m512 from[2];
        for (int half = 0; half < 2; ++half) {
          const int d = step * DEPTH + half * LANES;
          const __mmask16 some = __mmask16((1u << std::max(0, std::min(LANES, dims - d))) - 1);
          from[half] = _mm512_maskz_loadu_ps(some, points + (size_t)i * dims + d);
          from[half] = _mm512_sub_ps(from[half], _mm512_loadu_ps(&mean[d]));
          squares = _mm512_fmadd_ps(from[half], from[half], squares);
        }
        const Rounded query(_mm512_mul_ps(twice, from[0]), _mm512_mul_ps(twice, from[1])), point(from[0], from[1]);
        put_(i, 2 * step, query.high, point.high);
        put_(i, 2 * step + 1, query.low, point.low);
      }
      // |q|^2 times 1 and 1 times |p|^2, each in three parts
      float left = _mm512_reduce_add_ps(squares);
      alignas(64) float query[DEPTH] = {}, point[DEPTH] = {};
      for (int part = 0; part < 3; ++part) {
        const float high = float_of(bits_of(left) & ~0xffff);
        query[part] = point[3 + part] = high;
        query[3 + part] = point[part] = 1;
        left -= high;
      }
      put_(i, 2 * steps_, bf16_(query), bf16_(point));
    }
  }

  // Of 32 queries from `first` on to all points: (32, padded), `stride` floats from one to the next.
  void distances(int first, int padded, float* out, int stride) const {
    const size_t tile = TILE * DEPTH, row = (2 * steps_ + 1) * tile;
    const uint16_t* q = queries_.data() + first / TILE * row;
    for (int j = 0; j < padded; j += 2 * TILE) {
      const uint16_t* p = points_.data() + j / TILE * row;
      clear_sums();
      load_rows(q + 2 * steps_ * tile, row);
      load_columns(p + 2 * steps_ * tile, row);
      multiply();
      for (size_t step = 0; step < 2 * steps_ * tile; step += 2 * tile)
        add_split_products(q + step, tile, row, p + step, tile, row);
      store_sums(out + j, stride);
    }
  }

 private:
  int steps_;
  std::vector<uint16_t> queries_, points_;  // blocks of 16 points, of each block 2 * steps + 1 tiles

  size_t size_(int padded) const { return (size_t)padded * (2 * steps_ + 1) * DEPTH; }

  static __m512i bf16_(const float* exact) {
    return Rounded(_mm512_load_ps(exact), _mm512_load_ps(exact + LANES)).high;
  }

  void put_(int i, int tile, __m512i query, __m512i point) {
    const size_t place = ((size_t)(i / TILE) * (2 * steps_ + 1) + tile) * TILE * DEPTH;
    _mm512_storeu_si512(&queries_[place + i % TILE * DEPTH], query);
    scatter_column(&points_[place + i % TILE * 2], point);
  }
};

#endif

}  // namespace

extern "C" {

// points (count, dims), count > 1; queries are the first `rows` of them; out (rows, k) indices, self left out.
void straightpcf_knn(const float* points, int count, int dims, int rows, int k, int32_t* out) {
  const int padded = (count + GROUPS - 1) / GROUPS * GROUPS;
  Candidates near(padded);
#if defined(__AMX_BF16__)
  if (dims >= MANY_DIMS) {
    const Products products(points, count, dims, padded);
    const int stride = padded + LANES;  // rows 4 KiB apart would share a set of the cache
    std::vector<float> block((size_t)2 * TILE * stride);
    configure_tiles();
    for (int first = 0; first < rows; first += 2 * TILE) {
      products.distances(first, padded, block.data(), stride);
      for (int q = 0; q < std::min(2 * TILE, rows - first); ++q) {
        float* row = &block[(size_t)q * stride];
        std::fill(row + count, row + padded, FAR);
        row[first + q] = FAR;
        select(row, padded, k, near, out + (size_t)(first + q) * k);
      }
    }
    _tile_release();
    return;
  }
#endif
  const bool many = dims >= MANY_DIMS;
  std::vector<float> mean(dims, 0.0f), squares(padded, 0.0f);
  for (int i = 0; many && i < count; ++i)  // squares of what all have in common would swallow the rest
    for (int d = 0; d < dims; ++d) mean[d] += points[(size_t)i * dims + d] / count;
  keep_numbers(mean);
  std::vector<float> panels((size_t)padded * dims, 0.0f), from((size_t)padded * dims, 0.0f);
  for (int i = 0; i < count; ++i)
    for (int d = 0; d < dims; ++d) {
      const float x = points[(size_t)i * dims + d] - mean[d];
      squares[i] += x * x;
      panels[((size_t)(i / PANEL) * dims + d) * PANEL + i % PANEL] = x;
      from[(size_t)i * dims + d] = many ? -2 * x : x;
    }
  std::vector<float> distance((size_t)ROWS * padded);
  for (int first = 0; first < rows; first += ROWS) {
    const int block = std::min(ROWS, rows - first);
    const float* queries = &from[(size_t)first * dims];
    if (many) distances_by_products(panels.data(), squares.data(), first, padded, queries, dims, distance.data());
    else distances(panels.data(), padded, queries, dims, distance.data());
    for (int q = 0; q < block; ++q) {
      float* row = &distance[(size_t)q * padded];
      std::fill(row + count, row + padded, FAR);
      row[first + q] = FAR;
      select(row, padded, k, near, out + (size_t)(first + q) * k);
    }
  }
}

}  // extern "C"
