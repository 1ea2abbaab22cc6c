// The kernels' C interface, and the choice of the instruction set at run time. See ../README.md.
//
// Every function that uses vector registers is in vector.inc, which is compiled once for each instruction set by
// target attributes: no flag of the build lets the compiler use more than the processor is then found to have. Nothing
// of the standard library's templates is used in there, since the linker would keep one of the two versions for both.

#include <immintrin.h>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <thread>
#include <vector>

namespace {

constexpr int64_t PAD = 16;    // rows of matrices are padded to so many numbers, in both instruction sets
constexpr int64_t BLOCK = 64;  // samples at once: their activations stay in the first-level cache
constexpr float TINY = 1.17549435e-38f;  // smallest normal number, see student_t.py
constexpr float LIMIT = 3.4028234663852886e38f / 16;
constexpr float FAR_AWAY = 1e9f;  // standardised distances that are taken for infinite, see objectives/actor.py
constexpr double HALF_LOG_2PI = 0.91893853320467274178;

inline int64_t padded(int64_t n) { return (n + PAD - 1) / PAD * PAD; }

// Of a network of hidden layers with RMSNorm and Squish, and a last layer that gives means and raw scales.
struct Network {
  int64_t members, rows, linears;
  const int64_t* sizes;        // [linears + 1]
  const float* const* params;  // weight, bias, norm weight of each hidden layer; weight, bias: each [members, ...]
  const float* eps;            // [linears - 1]
  float min_scale;
};

// Of many tensors in one flat vector, each of which has a number of segments (members) with scalars of their own.
struct Segments {
  int64_t tensors;
  const int64_t* counts;   // segments of each tensor
  const int64_t* lengths;  // entries of each of its segments
};

struct AdaTermOptions {
  double lr, beta1, beta2, beta_nu, eps, k, weight_decay;
};

struct CATOptions {
  double tau, strength, eps, k;
};

// Numbers that a pass keeps for its gradient: of each hidden layer the normalised values and the inverse norms, and
// the raw scales.
inline int64_t kept_size(const Network& n) {
  int64_t size = n.rows * (n.sizes[n.linears] / 2);
  for (int64_t l = 1; l < n.linears; ++l) size += n.rows * (padded(n.sizes[l]) + 1);
  return size;
}

inline int64_t widest(const Network& n) {
  int64_t most = 0;
  for (int64_t l = 0; l <= n.linears; ++l) most = padded(n.sizes[l]) > most ? padded(n.sizes[l]) : most;
  return most;
}

// Numbers that a thread needs to work with: weights, gradients, and the activations of a block, all with padded rows.
inline int64_t scratch_size(const Network& n) {
  int64_t size = 6 * BLOCK * widest(n);
  for (int64_t l = 0; l < n.linears; ++l) {
    int64_t in = padded(n.sizes[l]), out = padded(n.sizes[l + 1]);
    size += 2 * in * out + 6 * out;
  }
  return size;
}

// AdaTerm's and CAT-soft's share of the rate and next degrees of freedom: robust_rate of student_t.py for one segment.
inline double robust_rate(double distance, float* nu, double rate_nu, double k, double eps) {
  if (std::isinf(k)) return 1.0;
  double old = *nu, one_more = old + 1;
  double weight = one_more / (old + distance);
  weight = weight > TINY ? weight : TINY;
  double largest = one_more / old;
  double w_nu = weight - std::log(weight), w_nu_max = largest - std::log(largest), least = -std::log(double(TINY));
  if (w_nu_max < least) w_nu_max = least;
  double pull = (one_more + 1 / one_more) * (1 - k / old) + w_nu * (k + eps - old);
  *nu = float(old + rate_nu * pull / w_nu_max);
  return weight / largest;
}

}  // namespace

#define FN __attribute__((target("avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")))
namespace avx512 {
using V = __m512;
constexpr int W = 16, COLUMNS = 4, ROWS = 6;  // 24 sums, 4 columns and a row's number: 29 of 32 registers
#define OP static inline __attribute__((always_inline)) FN
OP V load(const float* p) { return _mm512_loadu_ps(p); }
OP void store(float* p, V v) { _mm512_storeu_ps(p, v); }
OP V all(float x) { return _mm512_set1_ps(x); }
OP V fma(V a, V b, V c) { return _mm512_fmadd_ps(a, b, c); }
OP V add(V a, V b) { return _mm512_add_ps(a, b); }
OP V sub(V a, V b) { return _mm512_sub_ps(a, b); }
OP V mul(V a, V b) { return _mm512_mul_ps(a, b); }
OP V div(V a, V b) { return _mm512_div_ps(a, b); }
OP V root(V a) { return _mm512_sqrt_ps(a); }
OP V least(V bound, V x) { return _mm512_min_ps(bound, x); }  // NaN where x is
OP V most(V bound, V x) { return _mm512_max_ps(bound, x); }
OP float sum(V a) { return _mm512_reduce_add_ps(a); }
OP V rough_rsqrt(V a) { return _mm512_rsqrt14_ps(a); }
#include "vector.inc"
#undef OP
}  // namespace avx512
#undef FN

#define FN __attribute__((target("avx2,fma")))
namespace avx2 {
using V = __m256;
constexpr int W = 8, COLUMNS = 2, ROWS = 6;  // 12 sums, 2 columns and a row's number: 15 of 16 registers
#define OP static inline __attribute__((always_inline)) FN
OP V load(const float* p) { return _mm256_loadu_ps(p); }
OP void store(float* p, V v) { _mm256_storeu_ps(p, v); }
OP V all(float x) { return _mm256_set1_ps(x); }
OP V fma(V a, V b, V c) { return _mm256_fmadd_ps(a, b, c); }
OP V add(V a, V b) { return _mm256_add_ps(a, b); }
OP V sub(V a, V b) { return _mm256_sub_ps(a, b); }
OP V mul(V a, V b) { return _mm256_mul_ps(a, b); }
OP V div(V a, V b) { return _mm256_div_ps(a, b); }
OP V root(V a) { return _mm256_sqrt_ps(a); }
OP V least(V bound, V x) { return _mm256_min_ps(bound, x); }  // NaN where x is
OP V most(V bound, V x) { return _mm256_max_ps(bound, x); }
OP float sum(V a) {
  __m128 half = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
  half = _mm_add_ps(half, _mm_movehl_ps(half, half));
  return _mm_cvtss_f32(_mm_add_ss(half, _mm_movehdup_ps(half)));
}
OP V rough_rsqrt(V a) { return _mm256_rsqrt_ps(a); }
#include "vector.inc"
#undef OP
}  // namespace avx2
#undef FN

namespace {

// What is chosen: 2 for AVX-512, 1 for AVX2, 0 for nothing.
int found() {
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    return 2;
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}

int level = found();

// Calls work(item, scratch) for each item, by some threads; each item is the work of one, so that their number does
// not change what comes out.
template <class Work>
void spread(int64_t items, int64_t threads, int64_t scratch_floats, Work work) {
  if (threads > items) threads = items;
  auto run = [&](int64_t first) {
    float* scratch = static_cast<float*>(std::aligned_alloc(64, (scratch_floats * 4 + 63) / 64 * 64));
    for (int64_t item = first; item < items; item += threads) work(item, scratch);
    std::free(scratch);
  };
  if (threads <= 1) {
    threads = 1;
    run(0);
    return;
  }
  std::vector<std::thread> others;
  for (int64_t first = 1; first < threads; ++first) others.emplace_back(run, first);
  run(0);
  for (auto& other : others) other.join();
}

}  // namespace

#define CHOSEN(call) (level == 2 ? avx512::call : avx2::call)

extern "C" {

int tsallis_version() { return 1; }
int tsallis_level() { return level; }
// For tests: a lower instruction set than the one that was found. Returns what is used.
int tsallis_use_level(int wanted) {
  int most = found();
  level = wanted < most ? wanted : most;
  return level;
}

int64_t tsallis_kept_size(int64_t rows, int64_t linears, const int64_t* sizes) {
  return kept_size(Network{1, rows, linears, sizes, nullptr, nullptr, 0.0f});
}

void tsallis_network_forward(int64_t members, int64_t rows, int64_t linears, const int64_t* sizes, const float* x,
                             const float* const* params, const float* eps, float min_scale, float* loc, float* scale,
                             float* kept, int64_t threads) {
  Network n{members, rows, linears, sizes, params, eps, min_scale};
  spread(members, threads, scratch_size(n),
         [&](int64_t m, float* scratch) { CHOSEN(forward(n, m, x, loc, scale, kept, scratch)); });
}

void tsallis_network_backward(int64_t members, int64_t rows, int64_t linears, const int64_t* sizes, const float* x,
                              const float* const* params, const float* eps, const float* kept, const float* grad_loc,
                              const float* grad_scale, float* const* grads, int64_t threads) {
  Network n{members, rows, linears, sizes, params, eps, 0.0f};
  spread(members, threads, scratch_size(n), [&](int64_t m, float* scratch) {
    CHOSEN(backward(n, m, x, kept, grad_loc, grad_scale, grads, scratch));
  });
}

void tsallis_log_density(int64_t rows, int64_t dims, const float* loc, const float* scale, const float* action,
                         float* out) {
  CHOSEN(log_density(rows, dims, loc, scale, action, out));
}

void tsallis_log_density_gradient(int64_t rows, int64_t dims, const float* loc, const float* scale,
                                  const float* action, const float* grad, float* by_loc, float* by_scale) {
  CHOSEN(log_density_gradient(rows, dims, loc, scale, action, grad, by_loc, by_scale));
}

void tsallis_adaterm(int64_t tensors, const int64_t* counts, const int64_t* lengths, float* const* params,
                     const float* const* grads, float* m, float* s, float* floor, float* nu, float* step,
                     float* skipped, const double* options) {
  AdaTermOptions o{options[0], options[1], options[2], options[3], options[4], options[5], options[6]};
  CHOSEN(adaterm(Segments{tensors, counts, lengths}, params, grads, m, s, floor, nu, step, skipped, o));
}

void tsallis_cat_distance(int64_t tensors, const int64_t* counts, const int64_t* lengths, const float* const* source,
                          const float* const* target, const float* scale, float* distance) {
  CHOSEN(cat_distance(Segments{tensors, counts, lengths}, source, target, scale, distance));
}

void tsallis_cat(int64_t tensors, const int64_t* counts, const int64_t* lengths, float* const* source,
                 float* const* target, float* scale, float* nu, const float* distance, const uint8_t* alone,
                 const double* options) {
  CATOptions o{options[0], options[1], options[2], options[3]};
  CHOSEN(cat(Segments{tensors, counts, lengths}, source, target, scale, nu, distance, alone, o));
}

}  // extern "C"
