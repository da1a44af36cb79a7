// One run of ns-3's Wi-Fi (802.11ax ad hoc, 5 GHz, 80 MHz, one stream) on a plan that plan.py / compare.py wrote.
//
// Plan, a line each (SI units):
//   node  x y z                        drones, in the order of their ids
//   bcast t sender bytes id            a group-addressed datagram of `bytes` of UDP payload, AC_VO
//   data  t sender receiver bytes id   a payload cut into fragments of --fragment bytes, each a UDP datagram, AC_BE
//   sat   sender receiver              a flow that is always backlogged, AC_BE
//
// Out (--out prefix): PREFIX.data.csv, PREFIX.bcast.csv; on stdout one line of JSON.
// Build: see Makefile. Made for ns-3 3.37 (Debian bookworm, libns3-dev).

#include <chrono>
#include <cmath>
#include <ctime>
#include <fstream>
#include <iostream>
#include <map>
#include <set>
#include <sstream>
#include <vector>

#include "ns3/core-module.h"
#include "ns3/internet-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/neighbor-cache-helper.h"
#include "ns3/traffic-control-module.h"
#include "ns3/wifi-module.h"

using namespace ns3;

/// When the plan begins, s of ns-3's clock.
static double g_begin_s = 0.0;

/// Seconds of the plan.
static double
PlanTime(Time t = Simulator::Now())
{
    return t.GetSeconds() - g_begin_s;
}

// --- the channel: what the project's radio/channel.py adds to the path loss ------------------------------

/// Shadowing by pair and frame out of a file, Rician fading by PPDU or by frame; or one loss for all pairs.
class LinkLoss : public PropagationLossModel
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId tid =
            TypeId("LinkLoss").SetParent<PropagationLossModel>().AddConstructor<LinkLoss>();
        return tid;
    }

    std::vector<float> shadow; ///< [frames, n, n], dB, added to the SNR
    size_t n = 0;
    double frame_s = 0.1;
    double k = -1.0; ///< Rician factor, linear; < 0: no fading
    bool byFrame = false;

  private:
    double Fade() const
    {
        double a = std::sqrt(k / (k + 1.0)) + m_normal->GetValue() * std::sqrt(0.5 / (k + 1.0));
        double b = m_normal->GetValue() * std::sqrt(0.5 / (k + 1.0));
        return 10.0 * std::log10(std::max(1e-9, a * a + b * b));
    }

    double DoCalcRxPower(double dbm, Ptr<MobilityModel> a, Ptr<MobilityModel> b) const override
    {
        size_t i = a->GetObject<Node>()->GetId(), j = b->GetObject<Node>()->GetId();
        size_t frame = static_cast<size_t>(std::max(0.0, PlanTime()) / frame_s);
        if (!shadow.empty())
        {
            size_t frames = shadow.size() / (n * n);
            dbm += shadow[(std::min(frame, frames - 1) * n + i) * n + j];
        }
        if (k >= 0.0 && !byFrame)
        {
            dbm += Fade();
        }
        else if (k >= 0.0)
        {
            auto& held = m_held[i * 1000 + j];
            if (held.first != frame + 1)
            {
                held = {frame + 1, Fade()};
            }
            dbm += held.second;
        }
        return dbm;
    }

    int64_t DoAssignStreams(int64_t stream) override
    {
        m_normal->SetStream(stream);
        return 1;
    }

    mutable std::map<size_t, std::pair<size_t, double>> m_held;
    Ptr<NormalRandomVariable> m_normal = CreateObject<NormalRandomVariable>();
};

NS_OBJECT_ENSURE_REGISTERED(LinkLoss);

/// ns-3's tables with LDPC for all but legacy frames: 3.37 forgets the coding on the way through the HE header, and a
/// receiver takes every frame for BCC, 5 dB worse at MCS 11, whatever "LdpcSupported" says.
class LdpcTable : public ErrorRateModel
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId tid =
            TypeId("LdpcTable").SetParent<ErrorRateModel>().AddConstructor<LdpcTable>();
        return tid;
    }

  private:
    double DoGetChunkSuccessRate(WifiMode mode,
                                 const WifiTxVector& vector,
                                 double snr,
                                 uint64_t bits,
                                 uint8_t antennas,
                                 WifiPpduField field,
                                 uint16_t sta) const override
    {
        if (mode.GetModulationClass() < WIFI_MOD_CLASS_HT)
        {
            return m_table->GetChunkSuccessRate(mode, vector, snr, bits, antennas, field, sta);
        }
        WifiTxVector coded = vector;
        coded.SetLdpc(true);
        return m_table->GetChunkSuccessRate(mode, coded, snr, bits, antennas, field, sta);
    }

    Ptr<TableBasedErrorRateModel> m_table = CreateObject<TableBasedErrorRateModel>();
};

NS_OBJECT_ENSURE_REGISTERED(LdpcTable);

/// A PHY over the Yans channel that keeps account of interference when it switches to a stronger frame.
///
/// ns-3 3.44 does not, with this channel: its only band is 0 ... 0 Hz, which lies outside the frequency range that it names
/// (2401 ... 7125 MHz), so that InterferenceHelper::NotifyRxEnd updates nothing. A frame that arrives up to 4 us after
/// another and is captured is then decoded as if the first one were not there.
class ExactYansPhy : public YansWifiPhy
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId tid =
            TypeId("ExactYansPhy").SetParent<YansWifiPhy>().AddConstructor<ExactYansPhy>();
        return tid;
    }

    FrequencyRange GetCurrentFrequencyRange() const override
    {
        return {MHz_u{-1}, MHz_u{1}};
    }
};

NS_OBJECT_ENSURE_REGISTERED(ExactYansPhy);

struct PhyHelper : public YansWifiPhyHelper
{
    explicit PhyHelper(bool exact)
    {
        if (exact)
        {
            m_phys.front().SetTypeId("ExactYansPhy");
        }
    }
};

// --- the traffic -----------------------------------------------------------------------------------------

struct Payload
{
    double t_s;
    uint32_t sender, receiver, bytes, fragments, got;
    double last_s;
};

struct Call
{
    double t_s;
    uint32_t sender, bytes;
    std::vector<float> delay_s; ///< by receiver, < 0: not heard
};

struct Head
{
    uint32_t what, id, fragment; ///< what: 0 broadcast, 1 payload, 2 saturated, 3 before the plan
};

class Run
{
  public:
    std::map<uint32_t, Payload> payloads;
    std::map<uint32_t, Call> calls;
    std::vector<std::pair<uint32_t, uint32_t>> sat;
    std::vector<uint64_t> satBytes, satSeen;
    std::vector<Ptr<Socket>> data;
    static constexpr uint16_t groupProtocol = 0x88b5;
    std::vector<Ipv4Address> ip;
    std::vector<Ptr<WifiNetDevice>> dev;
    std::vector<std::map<WifiPhyState, double>> states;
    uint32_t fragment = 1344, header = 84, groupHeader = 60;
    double warm_s = 0.5, stop_s = 5.0;
    uint64_t acked = 0, nacked = 0, expired = 0, psdus = 0, dropped = 0;
    std::ofstream frames;

    Ptr<Packet> Make(Head head, uint32_t bytes)
    {
        Ptr<Packet> p = Create<Packet>(reinterpret_cast<const uint8_t*>(&head), sizeof(head));
        p->AddPaddingAtEnd(bytes - sizeof(head));
        return p;
    }

    void SendPayload(uint32_t id)
    {
        Payload& f = payloads[id];
        uint32_t left = f.bytes;
        for (uint32_t k = 0; k < f.fragments; ++k)
        {
            uint32_t size = std::min(left, fragment);
            left -= size;
            data[f.sender]->SendTo(Make({1, id, k}, size + header),
                                   0,
                                   InetSocketAddress(ip[f.receiver], 9));
        }
    }

    /// Two frames, so that the pair agrees on block acks.
    void Meet(uint32_t sender, uint32_t receiver)
    {
        for (uint32_t k = 0; k < 2; ++k)
        {
            data[sender]->SendTo(Make({3, 0, k}, header), 0, InetSocketAddress(ip[receiver], 9));
        }
    }

    void SendCall(uint32_t id)
    {
        Call& c = calls[id];
        // straight to the device, UDP/IP's 28 B as padding: a UDP socket's priority does not reach the MAC in 3.37
        // once traffic control is off, and the frame would go out in AC_BE
        Ptr<Packet> p = Make({0, id, 0}, c.bytes + groupHeader + 28);
        SocketPriorityTag tag;
        tag.SetPriority(6);
        p->AddPacketTag(tag);
        dev[c.sender]->Send(p, Mac48Address::GetBroadcast(), groupProtocol);
    }

    void TopUp(uint32_t flow)
    {
        auto [s, r] = sat[flow];
        auto queue = dev[s]->GetMac()->GetTxopQueue(AC_BE);
        for (uint32_t have = queue->GetNPackets(); have < 300; ++have)
        {
            data[s]->SendTo(Make({2, flow, 0}, fragment + header), 0, InetSocketAddress(ip[r], 9));
        }
        Simulator::Schedule(MicroSeconds(500), &Run::TopUp, this, flow);
    }

    void Hear(uint32_t me, Ptr<const Packet> p)
    {
        Head h;
        p->CopyData(reinterpret_cast<uint8_t*>(&h), sizeof(h));
        Call& c = calls[h.id];
        c.delay_s[me] = PlanTime() - c.t_s;
    }

    void Receive(uint32_t me, Ptr<Socket> socket)
    {
        double now = PlanTime();
        while (Ptr<Packet> p = socket->Recv())
        {
            Head h;
            p->CopyData(reinterpret_cast<uint8_t*>(&h), sizeof(h));
            if (h.what == 1)
            {
                Payload& f = payloads[h.id];
                f.got += 1;
                f.last_s = now;
            }
            else if (h.what == 2 && now >= warm_s)
            {
                satBytes[h.id] += fragment;
            }
        }
    }

    void Sent(uint32_t me, WifiConstPsduMap psdus, WifiTxVector vector, double)
    {
        Ptr<const WifiPsdu> psdu = psdus.begin()->second;
        const WifiMacHeader& mac = psdu->GetHeader(0);
        Mac48Address to = mac.GetAddr1();
        int receiver = -1;
        for (size_t i = 0; i < dev.size() && !to.IsGroup(); ++i)
        {
            receiver = dev[i]->GetMac()->GetAddress() == to ? static_cast<int>(i) : receiver;
        }
        uint32_t payload = 0;
        if (mac.IsQosData() && !to.IsGroup())
        {
            payload = psdu->GetPayload(0)->GetSize();
        }
        frames << std::llround(PlanTime() * 1e9) << ',' << me << ',' << receiver << ',' << mac.GetTypeString() << ','
               << psdu->GetNMpdus() << ','
               << WifiPhy::CalculateTxDuration(psdus, vector, WIFI_PHY_BAND_5GHZ).GetNanoSeconds() << ','
               << mac.GetSequenceNumber() << ',' << mac.IsRetry() << ',' << payload << '\n';
    }

    void State(uint32_t me, Time start, Time duration, WifiPhyState state)
    {
        double a = std::max(PlanTime(start), warm_s);
        double b = std::min(PlanTime(start + duration), stop_s);
        if (b > a)
        {
            states[me][state] += b - a;
        }
    }
};

static Run g_run;

int
main(int argc, char* argv[])
{
    std::string plan, out, rate = "HeMcs7", shadow, fade = "none";
    double kDb = 12.0, equalLoss = -1.0, lifetime = 0.1, exponent = 2.1, txPower = 20.0;
    uint32_t window = 64, ampdu = 64, run = 1, beAifsn = 3, voCw = 3, voAifsn = 2, retries = 7, rts = 0, ackMbps = 24;
    double rssi = -82.0;
    bool explicitBar = true, ldpc = true, frames = false, exact = false, meet = false;
    CommandLine cmd;
    cmd.AddValue("plan", "plan file", plan);
    cmd.AddValue("out", "prefix of the files to write; empty: none", out);
    cmd.AddValue("rate", "HeMcsN, ideal or minstrel", rate);
    cmd.AddValue("ampdu", "MPDUs an A-MPDU at most; 1: no aggregation and plain acks", ampdu);
    cmd.AddValue("window", "of the block ack, frames: 64 or 256", window);
    cmd.AddValue("fragment", "payload bytes of a datagram", g_run.fragment);
    cmd.AddValue("warm", "figures count from here, s", g_run.warm_s);
    cmd.AddValue("stop", "end, s", g_run.stop_s);
    cmd.AddValue("run", "seed", run);
    cmd.AddValue("beAifsn", "AIFSN of AC_BE (standard 3)", beAifsn);
    cmd.AddValue("voCw", "CWmin of AC_VO (standard 3)", voCw);
    cmd.AddValue("voAifsn", "AIFSN of AC_VO (standard 2)", voAifsn);
    cmd.AddValue("retries", "MAC retries", retries);
    cmd.AddValue("rts", "1: RTS/CTS before every data frame", rts);
    cmd.AddValue("ackMbps", "fastest rate of acks", ackMbps);
    cmd.AddValue("lifetime", "of an MSDU in the queue, s", lifetime);
    cmd.AddValue("shadow", "binary float32 [frames, n, n] of dB added to the SNR", shadow);
    cmd.AddValue("fade", "none, ppdu or frame: Rician", fade);
    cmd.AddValue("k", "Rician factor, dB", kDb);
    cmd.AddValue("equalLoss", "one loss for all pairs, dB; < 0: log distance", equalLoss);
    cmd.AddValue("exponent", "of the path loss", exponent);
    cmd.AddValue("txPower", "dBm", txPower);
    cmd.AddValue("rssi", "weakest preamble that is detected, dBm", rssi);
    cmd.AddValue("explicitBar", "BlockAckReq after a missed block ack", explicitBar);
    cmd.AddValue("ldpc", "LDPC as HE at 80 MHz has it; ns-3's default is BCC", ldpc);
    cmd.AddValue("exact", "1: a captured frame is interfered with by those that came before it", exact);
    cmd.AddValue("meet", "1: before the plan begins, one pair after another agrees on block acks", meet);
    cmd.AddValue("frames", "1: write PREFIX.frames.csv, a line each frame", frames);
    cmd.Parse(argc, argv);
    if (frames)
    {
        g_run.frames.open(out + ".frames.csv");
        g_run.frames << "t_ns,station,to,kind,mpdus,ns,sequence,retry,bytes\n";
    }
    RngSeedManager::SetRun(run);

    std::vector<Vector> places;
    std::ifstream in(plan);
    for (std::string line; std::getline(in, line);)
    {
        std::istringstream s(line);
        std::string word;
        s >> word;
        double t;
        uint32_t a, b, bytes, id;
        if (word == "node")
        {
            Vector v;
            s >> v.x >> v.y >> v.z;
            places.push_back(v);
        }
        else if (word == "bcast")
        {
            s >> t >> a >> bytes >> id;
            g_run.calls[id] = {t, a, bytes, {}};
        }
        else if (word == "data")
        {
            s >> t >> a >> b >> bytes >> id;
            uint32_t k = (bytes + g_run.fragment - 1) / g_run.fragment;
            g_run.payloads[id] = {t, a, b, bytes, k, 0, -1.0};
        }
        else if (word == "sat")
        {
            s >> a >> b;
            g_run.sat.push_back({a, b});
        }
    }
    const uint32_t n = places.size();
    g_run.satBytes.assign(g_run.sat.size(), 0);
    g_run.states.resize(n);

    Config::SetDefault("ns3::WifiMacQueue::MaxSize", QueueSizeValue(QueueSize("40000p")));
    Config::SetDefault("ns3::WifiMacQueue::MaxDelay",
                       TimeValue(Seconds(g_run.sat.empty() ? lifetime : 100.0)));
    Config::SetDefault("ns3::WifiRemoteStationManager::RtsCtsThreshold",
                       UintegerValue(rts ? 0 : 4692480));
    Config::SetDefault("ns3::WifiMac::FrameRetryLimit", UintegerValue(retries));
    Config::SetDefault("ns3::WifiRemoteStationManager::NonUnicastMode",
                       StringValue("OfdmRate6Mbps"));
    Config::SetDefault("ns3::QosTxop::UseExplicitBarAfterMissedBlockAck", BooleanValue(explicitBar));
    Config::SetDefault("ns3::ArpCache::PendingQueueSize", UintegerValue(10000));

    NodeContainer nodes(n);
    MobilityHelper mobility;
    Ptr<ListPositionAllocator> where = CreateObject<ListPositionAllocator>();
    for (auto& v : places)
    {
        where->Add(v);
    }
    mobility.SetPositionAllocator(where);
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
    mobility.Install(nodes);

    const double atOneMetre = 20.0 * std::log10(4.0 * M_PI * 5.2e9 / 299792458.0);
    Ptr<YansWifiChannel> channel = CreateObject<YansWifiChannel>();
    channel->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());
    Ptr<PropagationLossModel> loss;
    if (equalLoss >= 0.0)
    {
        auto fixed = CreateObject<FixedRssLossModel>();
        fixed->SetRss(txPower - equalLoss);
        loss = fixed;
    }
    else
    {
        auto far = CreateObject<LogDistancePropagationLossModel>();
        far->SetPathLossExponent(exponent);
        far->SetReference(1.0, atOneMetre);
        loss = far;
    }
    auto extra = CreateObject<LinkLoss>();
    extra->n = n;
    if (!shadow.empty())
    {
        std::ifstream file(shadow, std::ios::binary | std::ios::ate);
        extra->shadow.resize(file.tellg() / sizeof(float));
        file.seekg(0);
        file.read(reinterpret_cast<char*>(extra->shadow.data()),
                  extra->shadow.size() * sizeof(float));
    }
    extra->k = fade == "none" ? -1.0 : std::pow(10.0, kDb / 10.0);
    extra->byFrame = fade == "frame";
    loss->SetNext(extra);
    channel->SetPropagationLossModel(loss);

    PhyHelper phy(exact);
    phy.SetChannel(channel);
    phy.SetErrorRateModel(ldpc ? "LdpcTable" : "ns3::TableBasedErrorRateModel");
    phy.SetPreambleDetectionModel("ns3::ThresholdPreambleDetectionModel",
                                  "MinimumRssi",
                                  DoubleValue(rssi));
    phy.Set("ChannelSettings", StringValue("{42, 80, BAND_5GHZ, 0}"));
    phy.Set("TxPowerStart", DoubleValue(txPower));
    phy.Set("TxPowerEnd", DoubleValue(txPower));
    phy.Set("RxNoiseFigure", DoubleValue(7.0));
    phy.Set("Antennas", UintegerValue(1));
    phy.Set("MaxSupportedTxSpatialStreams", UintegerValue(1));
    phy.Set("MaxSupportedRxSpatialStreams", UintegerValue(1));

    WifiHelper wifi;
    wifi.SetStandard(WIFI_STANDARD_80211ax);
    wifi.ConfigHeOptions("GuardInterval", TimeValue(NanoSeconds(800)));
    Config::SetDefault("ns3::WifiMac::MpduBufferSize", UintegerValue(std::max(ampdu, window)));
    wifi.ConfigHtOptions("LdpcSupported", BooleanValue(ldpc));
    if (rate == "ideal")
    {
        wifi.SetRemoteStationManager("ns3::IdealWifiManager");
    }
    else if (rate == "minstrel")
    {
        wifi.SetRemoteStationManager("ns3::MinstrelHtWifiManager");
    }
    else
    {
        wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager",
                                     "DataMode",
                                     StringValue(rate),
                                     "ControlMode",
                                     StringValue("OfdmRate24Mbps"));
    }
    WifiMacHelper mac;
    // 1494 B frames and 4 B delimiters, padded to 1500 B
    uint32_t subframe = (g_run.fragment + g_run.header + 66 + 4 + 3) / 4 * 4;
    mac.SetType("ns3::AdhocWifiMac",
                "QosSupported",
                BooleanValue(true),
                "BE_MaxAmpduSize",
                UintegerValue(ampdu > 1 ? ampdu * subframe : 0),
                "VO_MaxAmpduSize",
                UintegerValue(0),
                "BE_MaxAmsduSize",
                UintegerValue(0));
    NetDeviceContainer devices = wifi.Install(phy, mac, nodes);

    InternetStackHelper stack;
    stack.Install(nodes);
    Ipv4AddressHelper addresses;
    addresses.SetBase("10.0.0.0", "255.0.0.0");
    Ipv4InterfaceContainer interfaces = addresses.Assign(devices);
    TrafficControlHelper().Uninstall(devices);
    NeighborCacheHelper().PopulateNeighborCache();

    for (uint32_t i = 0; i < n; ++i)
    {
        auto device = DynamicCast<WifiNetDevice>(devices.Get(i));
        g_run.dev.push_back(device);
        g_run.ip.push_back(interfaces.GetAddress(i));
        auto manager = device->GetRemoteStationManager();
        if (ackMbps >= 12)
        {
            manager->AddBasicMode(WifiMode("OfdmRate12Mbps"));
        }
        if (ackMbps >= 24)
        {
            manager->AddBasicMode(WifiMode("OfdmRate24Mbps"));
        }
        auto be = device->GetMac()->GetQosTxop(AC_BE);
        be->SetAifsn(beAifsn);
        be->SetMinCw(15);
        be->SetMaxCw(1023);
        be->SetTxopLimit(Seconds(0));
        auto vo = device->GetMac()->GetQosTxop(AC_VO);
        vo->SetAifsn(voAifsn);
        vo->SetMinCw(voCw);
        vo->SetMaxCw(std::max(7u, voCw));
        vo->SetTxopLimit(Seconds(0));
        if (frames)
        {
            device->GetPhy()->TraceConnectWithoutContext("PhyTxPsduBegin",
                                                         MakeBoundCallback(
                                                             +[](uint32_t me,
                                                                 WifiConstPsduMap psdus,
                                                                 WifiTxVector vector,
                                                                 double power) { g_run.Sent(me, psdus, vector, power); },
                                                             i));
        }
        device->GetPhy()->GetState()->TraceConnectWithoutContext(
            "State",
            MakeBoundCallback(
                +[](uint32_t me, Time start, Time duration, WifiPhyState state) {
                    g_run.State(me, start, duration, state);
                },
                i));
        device->GetMac()->TraceConnectWithoutContext(
            "AckedMpdu",
            MakeCallback(+[](Ptr<const WifiMpdu>) { ++g_run.acked; }));
        device->GetMac()->TraceConnectWithoutContext(
            "NAckedMpdu",
            MakeCallback(+[](Ptr<const WifiMpdu>) { ++g_run.nacked; }));
        device->GetMac()->TraceConnectWithoutContext(
            "DroppedMpdu",
            MakeCallback(+[](WifiMacDropReason reason, Ptr<const WifiMpdu>) {
                ++(reason == WIFI_MAC_DROP_EXPIRED_LIFETIME ? g_run.expired : g_run.dropped);
            }));

        auto open = [&]() {
            auto socket = Socket::CreateSocket(nodes.Get(i), UdpSocketFactory::GetTypeId());
            return socket;
        };
        auto listen = open();
        listen->SetAttribute("RcvBufSize", UintegerValue(1 << 30));
        listen->Bind(InetSocketAddress(Ipv4Address::GetAny(), 9));
        listen->SetRecvCallback(MakeBoundCallback(
            +[](uint32_t me, Ptr<Socket> s) { g_run.Receive(me, s); },
            i));
        g_run.data.push_back(open());
        g_run.data.back()->Bind();
        nodes.Get(i)->RegisterProtocolHandler(
            MakeCallback(+[](Ptr<NetDevice> d,
                             Ptr<const Packet> p,
                             uint16_t,
                             const Address&,
                             const Address&,
                             NetDevice::PacketType) { g_run.Hear(d->GetNode()->GetId(), p); }),
            Run::groupProtocol,
            device);
    }
    if (meet)
    {
        std::set<std::pair<uint32_t, uint32_t>> pairs(g_run.sat.begin(), g_run.sat.end());
        for (auto& [id, payload] : g_run.payloads)
        {
            pairs.insert({payload.sender, payload.receiver});
        }
        for (auto& [sender, receiver] : pairs)
        {
            g_begin_s += 0.005;
            Simulator::ScheduleWithContext(sender, Seconds(g_begin_s), &Run::Meet, &g_run, sender, receiver);
        }
        g_begin_s = std::ceil(10.0 * g_begin_s + 0.5) * 0.1;
    }
    for (auto& [id, call] : g_run.calls)
    {
        call.delay_s.assign(n, -1.0);
        Simulator::ScheduleWithContext(call.sender, Seconds(g_begin_s + call.t_s), &Run::SendCall, &g_run, id);
    }
    for (auto& [id, payload] : g_run.payloads)
    {
        Simulator::ScheduleWithContext(payload.sender,
                                       Seconds(g_begin_s + payload.t_s),
                                       &Run::SendPayload,
                                       &g_run,
                                       id);
    }
    for (uint32_t f = 0; f < g_run.sat.size(); ++f)
    {
        Simulator::Schedule(Seconds(g_begin_s) + MicroSeconds(1000 + 37 * f), &Run::TopUp, &g_run, f);
    }

    auto begin = std::chrono::steady_clock::now();
    std::clock_t cpu = std::clock();
    Simulator::Stop(Seconds(g_begin_s + g_run.stop_s));
    Simulator::Run();
    double wall = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();

    const double span = g_run.stop_s - g_run.warm_s;
    std::cout << "{\"wall_s\": " << wall
              << ", \"cpu_s\": " << double(std::clock() - cpu) / CLOCKS_PER_SEC << ", \"events\": " << Simulator::GetEventCount()
              << ", \"acked\": " << g_run.acked << ", \"nacked\": " << g_run.nacked
              << ", \"expired\": " << g_run.expired << ", \"dropped\": " << g_run.dropped
              << ", \"sat_mbps\": [";
    for (size_t f = 0; f < g_run.sat.size(); ++f)
    {
        std::cout << (f ? ", " : "") << g_run.satBytes[f] * 8e-6 / span;
    }
    std::cout << "], \"tx_s\": [";
    for (uint32_t i = 0; i < n; ++i)
    {
        std::cout << (i ? ", " : "") << g_run.states[i][WifiPhyState::TX];
    }
    std::cout << "], \"busy\": [";
    for (uint32_t i = 0; i < n; ++i)
    {
        auto& s = g_run.states[i];
        double busy = s[WifiPhyState::TX] + s[WifiPhyState::RX] + s[WifiPhyState::CCA_BUSY];
        std::cout << (i ? ", " : "") << busy / span;
    }
    std::cout << "]}" << std::endl;
    if (!out.empty())
    {
        std::ofstream d(out + ".data.csv");
        d << "id,t,sender,receiver,bytes,fragments,got,last\n";
        d.precision(9);
        for (auto& [id, f] : g_run.payloads)
        {
            d << id << ',' << f.t_s << ',' << f.sender << ',' << f.receiver << ',' << f.bytes << ','
              << f.fragments << ',' << f.got << ',' << f.last_s << '\n';
        }
        std::ofstream b(out + ".bcast.csv");
        b << "id,t,sender,receiver,delay\n";
        b.precision(9);
        for (auto& [id, c] : g_run.calls)
        {
            for (uint32_t j = 0; j < n; ++j)
            {
                if (j != c.sender)
                {
                    b << id << ',' << c.t_s << ',' << c.sender << ',' << j << ',' << c.delay_s[j]
                      << '\n';
                }
            }
        }
    }
    Simulator::Destroy();
    return 0;
}
