// The two loops the filter spends its time in, for one CPU thread: k nearest neighbours inside a patch,
// and the EdgeConv maximum with its gradient. Python calls them through ctypes (cpu.py), which releases
// the GIL, so callers run one patch per thread. Every function has a plain torch twin in model/ops.py.
//
// Compiled once per instruction set. Vectors are 16 floats; the compiler splits them where registers are
// narrower. With AVX512-BF16 the products are bfloat16 with float32 sums, otherwise float32 throughout.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>
#if defined(__AVX512F__)
#include <immintrin.h>
#endif

namespace {

constexpr int LANES = 16;
typedef float vec __attribute__((vector_size(64), aligned(4)));
typedef int32_t ivec __attribute__((vector_size(64), aligned(4)));

inline vec load(const float* p) { vec v; std::memcpy(&v, p, sizeof v); return v; }
inline void store(float* p, vec v) { std::memcpy(p, &v, sizeof v); }
inline vec splat(float x) { return vec{} + x; }

constexpr float FAR = 3.4e38f;  // of padding and of the query itself: never chosen
constexpr int QUERIES = 8;

// Squared distances of QUERIES queries to all points; `columns` is the patch transposed, (dims, padded).
inline void distances(const float* columns, int padded, const float* queries, int dims, float* out) {
  for (int j = 0; j < padded; j += 2 * LANES) {
    vec sum[QUERIES][2];
    for (int q = 0; q < QUERIES; ++q) sum[q][0] = sum[q][1] = vec{};
    for (int d = 0; d < dims; ++d) {
      const vec c0 = load(columns + (size_t)d * padded + j), c1 = load(columns + (size_t)d * padded + j + LANES);
      for (int q = 0; q < QUERIES; ++q) {
        const vec x = splat(queries[(size_t)q * dims + d]);
        const vec e0 = c0 - x, e1 = c1 - x;
        sum[q][0] += e0 * e0;
        sum[q][1] += e1 * e1;
      }
    }
    for (int q = 0; q < QUERIES; ++q) {
      store(out + (size_t)q * padded + j, sum[q][0]);
      store(out + (size_t)q * padded + j + LANES, sum[q][1]);
    }
  }
}

// What `select` needs beside its arguments: the candidates of one query, a vector longer than a patch.
struct Candidates {
  std::vector<float> distance;
  std::vector<int32_t> index;
  std::vector<uint64_t> keys;
  explicit Candidates(int padded) : distance(padded + LANES), index(padded + LANES), keys(padded) {}
};

#if defined(__AVX512F__)

// How many of `count` vectors' floats are at most the one whose bits are `bits`; floats >= 0 order as their bits do.
inline int at_most(const float* values, int count, int32_t bits) {
  const __m512i limit = _mm512_set1_epi32(bits);
  int found = 0;
  for (int n = 0; n < count; ++n)
    found += __builtin_popcount(_mm512_cmple_epi32_mask(_mm512_loadu_si512(values + n * LANES), limit));
  return found;
}

// Indices of the k smallest distances (ties go to the lower index), in no particular order.
// The k-th smallest of 64 disjoint groups' minima bounds the k-th smallest of all, so one pass leaves few candidates;
// both thresholds are found by bisection over the bits, which no branch predictor can get wrong.
inline void select(const float* distance, int padded, int k, Candidates& near, int32_t* out) {
  int32_t bound;
  std::memcpy(&bound, &FAR, 4);
  if (k <= 4 * LANES) {
    float least[4 * LANES];
    for (int g = 0; g < 4; ++g) {
      __m512 m = _mm512_loadu_ps(distance + g * LANES);
      for (int j = (g + 4) * LANES; j < padded; j += 4 * LANES) m = _mm512_min_ps(m, _mm512_loadu_ps(distance + j));
      _mm512_storeu_ps(least + g * LANES, m);
    }
    int32_t low = -1;
    for (int tries = 0; tries < 18; ++tries) {  // any bound that k of them reach will do
      const int32_t middle = low + (bound - low) / 2;
      const int found = at_most(least, 4, middle);
      (found >= k ? bound : low) = middle;
      if (found == k) break;
    }
  }
  const __m512i limit = _mm512_set1_epi32(bound), far = _mm512_castps_si512(_mm512_set1_ps(FAR));
  const __m512i step = _mm512_set1_epi32(LANES);
  __m512i index = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  int count = 0;
  for (int j = 0; j < padded; j += LANES, index = _mm512_add_epi32(index, step)) {
    const __m512i d = _mm512_loadu_si512(distance + j);
    const __mmask16 chosen = _mm512_cmple_epi32_mask(d, limit) & _mm512_cmplt_epi32_mask(d, far);
    _mm512_storeu_si512(&near.distance[count], _mm512_maskz_compress_epi32(chosen, d));
    _mm512_storeu_si512(&near.index[count], _mm512_maskz_compress_epi32(chosen, index));
    count += __builtin_popcount(chosen);
  }
  if (count <= k) {  // fewer points than neighbours: in order, then the farthest again
    for (int n = 0; n < count; ++n) {
      uint32_t bits;
      std::memcpy(&bits, &near.distance[n], 4);
      near.keys[n] = (uint64_t(bits) << 32) | uint32_t(near.index[n]);
    }
    std::sort(near.keys.begin(), near.keys.begin() + count);
    for (int n = 0; n < k; ++n) out[n] = int32_t(uint32_t(near.keys[std::min(n, count - 1)]));
    return;
  }
  _mm512_storeu_si512(&near.distance[count], far);
  const int vectors = (count + LANES - 1) / LANES;
  int32_t low = -1, high = bound;
  int reached = count;
  while (reached != k && high - low > 1) {
    const int32_t middle = low + (high - low) / 2;
    const int found = at_most(near.distance.data(), vectors, middle);
    if (found >= k) {
      high = middle;
      reached = found;
    } else {
      low = middle;
    }
  }
  const int32_t sure = reached == k ? high : low;  // else some lie exactly at `high`, and not all of them fit
  int taken = 0;
  for (int n = 0; n < count; ++n) {
    int32_t bits;
    std::memcpy(&bits, &near.distance[n], 4);
    out[taken] = near.index[n];
    taken += bits <= sure && taken < k;
    if (taken == k) return;
  }
  for (int n = 0; taken < k; ++n) {
    int32_t bits;
    std::memcpy(&bits, &near.distance[n], 4);
    if (bits == high) out[taken++] = near.index[n];
  }
}

#else

// Indices of the k smallest distances (ties go to the lower index), in no particular order.
// The k-th smallest of 64 disjoint groups' minima bounds the k-th smallest of all, so one pass leaves few keys.
inline void select(const float* distance, int padded, int k, Candidates& near, int32_t* out) {
  float bound = FAR;
  if (k <= 4 * LANES) {
    float least[4 * LANES];
    for (int g = 0; g < 4; ++g) {
      vec m = load(distance + g * LANES);
      for (int j = g * LANES + 4 * LANES; j < padded; j += 4 * LANES) {
        const vec d = load(distance + j);
        m = d < m ? d : m;
      }
      store(least + g * LANES, m);
    }
    std::nth_element(least, least + k - 1, least + 4 * LANES);
    bound = least[k - 1];
  }
  int count = 0;
  for (int j = 0; j < padded; ++j)
    if (distance[j] <= bound && distance[j] < FAR) {
      uint32_t bits;
      std::memcpy(&bits, &distance[j], 4);
      near.keys[count++] = (uint64_t(bits) << 32) | uint32_t(j);
    }
  const auto begin = near.keys.begin();
  if (count > k) std::nth_element(begin, begin + k, begin + count);
  else std::sort(begin, begin + count);
  for (int n = 0; n < k; ++n) out[n] = int32_t(uint32_t(near.keys[std::min(n, count - 1)]));
}

#endif

}  // namespace

extern "C" {

// points (count, dims), count > 1; queries are the first `rows` of them; out (rows, k) indices, self left out.
void straightpcf_knn(const float* points, int count, int dims, int rows, int k, int32_t* out) {
  const int padded = (count + 63) / 64 * 64;
  std::vector<float> columns((size_t)dims * padded, 0.0f), distance((size_t)QUERIES * padded);
  std::vector<float> queries((size_t)QUERIES * dims);
  Candidates near(padded);
  for (int i = 0; i < count; ++i)
    for (int d = 0; d < dims; ++d) columns[(size_t)d * padded + i] = points[(size_t)i * dims + d];
  for (int first = 0; first < rows; first += QUERIES) {
    const int block = std::min(QUERIES, rows - first);
    std::memcpy(queries.data(), points + (size_t)first * dims, (size_t)block * dims * sizeof(float));
    distances(columns.data(), padded, queries.data(), dims, distance.data());
    for (int q = 0; q < block; ++q) {
      float* row = &distance[(size_t)q * padded];
      std::fill(row + count, row + padded, FAR);
      row[first + q] = FAR;
      select(row, padded, k, near, out + (size_t)(first + q) * k);
    }
  }
}

// W (out_width, width) -> packed for edge_max. Size: width * out_width floats (bf16 uses half of it).
void straightpcf_pack(const float* weight, int width, int out_width, float* packed) {
#if defined(__AVX512BF16__)
  uint16_t* half = reinterpret_cast<uint16_t*>(packed);
  for (int c0 = 0; c0 < out_width; c0 += LANES)
    for (int d = 0; d < width; d += 2)
      for (int lane = 0; lane < LANES; ++lane)
        for (int p = 0; p < 2; ++p) {
          uint32_t bits;
          std::memcpy(&bits, &weight[(size_t)(c0 + lane) * width + d + p], 4);
          bits += 0x7fff + ((bits >> 16) & 1);
          half[((size_t)c0 * width) + (size_t)d * LANES + lane * 2 + p] = uint16_t(bits >> 16);
        }
#else
  for (int c0 = 0; c0 < out_width; c0 += LANES)
    for (int d = 0; d < width; ++d)
      for (int lane = 0; lane < LANES; ++lane)
        packed[(size_t)c0 * width + (size_t)d * LANES + lane] = weight[(size_t)(c0 + lane) * width + d];
#endif
}

}  // extern "C"

namespace {

// One block of ROWS edges by COLS*16 channels: products with the packed weight, then the running maximum.
template <int ROWS, int COLS>
inline void block(const void* hidden_, int width, const void* packed_, int first, vec* best, ivec* which) {
#if defined(__AVX512BF16__)
  const uint16_t* hidden = static_cast<const uint16_t*>(hidden_);
  const uint16_t* packed = static_cast<const uint16_t*>(packed_);
  __m512 sum[ROWS][COLS];
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) sum[r][c] = _mm512_setzero_ps();
  for (int d = 0; d < width; d += 2) {
    __m512bh w[COLS];
    for (int c = 0; c < COLS; ++c)
      w[c] = (__m512bh)_mm512_loadu_si512(packed + (size_t)c * LANES * width + (size_t)d * LANES);
    for (int r = 0; r < ROWS; ++r) {
      int32_t pair;
      std::memcpy(&pair, hidden + (size_t)r * width + d, 4);
      const __m512bh h = (__m512bh)_mm512_set1_epi32(pair);
      for (int c = 0; c < COLS; ++c) sum[r][c] = _mm512_dpbf16_ps(sum[r][c], h, w[c]);
    }
  }
#else
  const float* hidden = static_cast<const float*>(hidden_);
  const float* packed = static_cast<const float*>(packed_);
  vec sum[ROWS][COLS];
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) sum[r][c] = vec{};
  for (int d = 0; d < width; ++d) {
    vec w[COLS];
    for (int c = 0; c < COLS; ++c) w[c] = load(packed + (size_t)c * LANES * width + (size_t)d * LANES);
    for (int r = 0; r < ROWS; ++r) {
      const vec h = splat(hidden[(size_t)r * width + d]);
      for (int c = 0; c < COLS; ++c) sum[r][c] += h * w[c];
    }
  }
#endif
  for (int c = 0; c < COLS; ++c)
    for (int r = 0; r < ROWS; ++r) {
      const vec s = (vec)sum[r][c];
      const ivec more = s > best[c];
      best[c] = more ? s : best[c];
      which[c] = more ? (ivec{} + (first + r)) : which[c];
    }
}

// relu(a_i + b_j) for the edges of one point, in the type of the products.
inline void hidden_rows(const float* a, const float* b, const int32_t* index, int k, int width, void* out_) {
  for (int n = 0; n < k; ++n) {
    const float* row = b + (size_t)index[n] * width;
    for (int d = 0; d < width; d += LANES) {
      vec h = load(a + d) + load(row + d);
      h = h > 0 ? h : vec{};
#if defined(__AVX512BF16__)
      const __m256bh half = _mm512_cvtneps_pbh((__m512)h);
      std::memcpy(static_cast<uint16_t*>(out_) + (size_t)n * width + d, &half, 32);
#else
      store(static_cast<float*>(out_) + (size_t)n * width + d, h);
#endif
    }
  }
}

template <int COLS>
void edge_max(const float* a, const float* b, const int32_t* index, const float* packed, int rows, int k, int width,
              int out_width, float* out, uint8_t* arg) {
  std::vector<float> scratch((size_t)(k + 8) * width + LANES);
  char* hidden = reinterpret_cast<char*>(scratch.data());
#if defined(__AVX512BF16__)
  const size_t element = 2;
#else
  const size_t element = 4;
#endif
  for (int i = 0; i < rows; ++i) {
    hidden_rows(a + (size_t)i * width, b, index + (size_t)i * k, k, width, hidden);
    for (int c0 = 0; c0 < out_width; c0 += COLS * LANES) {
      vec best[COLS];
      ivec which[COLS];
      for (int c = 0; c < COLS; ++c) { best[c] = splat(-3.4e38f); which[c] = ivec{}; }
      const char* w = reinterpret_cast<const char*>(packed) + (size_t)c0 * width * element;
      int n = 0;
      for (; n + 8 <= k; n += 8) block<8, COLS>(hidden + (size_t)n * width * element, width, w, n, best, which);
      for (; n < k; ++n) block<1, COLS>(hidden + (size_t)n * width * element, width, w, n, best, which);
      for (int c = 0; c < COLS; ++c) {
        store(out + (size_t)i * out_width + c0 + c * LANES, best[c]);
        if (arg)
          for (int lane = 0; lane < LANES; ++lane)
            arg[(size_t)i * out_width + c0 + c * LANES + lane] = uint8_t(which[c][lane]);
      }
    }
  }
}

}  // namespace

extern "C" {

// out[i, c] = max_n sum_d relu(a[i, d] + b[index[i, n], d]) W[c, d]; arg (rows, out_width) says which n, may be null.
void straightpcf_edge_max(const float* a, const float* b, const int32_t* index, const float* packed, int rows, int k,
                          int width, int out_width, float* out, uint8_t* arg) {
  if (out_width % (2 * LANES) == 0)
    edge_max<2>(a, b, index, packed, rows, k, width, out_width, out, arg);
  else
    edge_max<1>(a, b, index, packed, rows, k, width, out_width, out, arg);
}

// The gradient: only the winning edge of each (i, c) carries any. grad_b and grad_weight are added to.
void straightpcf_edge_max_backward(const float* grad, const uint8_t* arg, const float* a, const float* b,
                                   const int32_t* index, const float* weight, int rows, int k, int width,
                                   int out_width, float* grad_a, float* grad_b, float* grad_weight) {
  std::vector<float> hidden((size_t)k * width), grad_hidden((size_t)k * width);
  for (int i = 0; i < rows; ++i) {
    for (int n = 0; n < k; ++n) {
      const float* row = b + (size_t)index[(size_t)i * k + n] * width;
      for (int d = 0; d < width; d += LANES) {
        const vec h = load(a + (size_t)i * width + d) + load(row + d);
        store(&hidden[(size_t)n * width + d], h > 0 ? h : vec{});
      }
    }
    std::memset(grad_hidden.data(), 0, grad_hidden.size() * sizeof(float));
    for (int c = 0; c < out_width; ++c) {
      const vec g = splat(grad[(size_t)i * out_width + c]);
      const size_t n = arg[(size_t)i * out_width + c];
      float* gw = grad_weight + (size_t)c * width;
      const float* w = weight + (size_t)c * width;
      float* gh = &grad_hidden[n * width];
      const float* h = &hidden[n * width];
      for (int d = 0; d < width; d += LANES) {
        store(gw + d, load(gw + d) + g * load(h + d));
        store(gh + d, load(gh + d) + g * load(w + d));
      }
    }
    float* ga = grad_a + (size_t)i * width;
    for (int d = 0; d < width; d += LANES) store(ga + d, vec{});
    for (int n = 0; n < k; ++n) {
      float* gb = grad_b + (size_t)index[(size_t)i * k + n] * width;
      for (int d = 0; d < width; d += LANES) {
        const vec open = load(&hidden[(size_t)n * width + d]);
        vec g = load(&grad_hidden[(size_t)n * width + d]);
        g = open > 0 ? g : vec{};
        store(ga + d, load(ga + d) + g);
        store(gb + d, load(gb + d) + g);
      }
    }
  }
}

// 1 where the products are bfloat16.
int straightpcf_products_are_bf16() {
#if defined(__AVX512BF16__)
  return 1;
#else
  return 0;
#endif
}

}  // extern "C"
